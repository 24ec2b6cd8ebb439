"""Factors by which ranges grow where held-out recordings deviate more than is predicted."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))

from ranges_files import MEANS, STD, covariance, make_twin, record, record_motion, true_arm

from pytest_twin.ranges import widening
from pytest_twin.ranges.ranges_of_twin import ranges_of_file
from pytest_twin.ranges.widening import Deviation, fewest_robots, widen


class Ranges:
    """A stand-in for a distribution of one coordinate of the elbow."""

    def __init__(self, factor: float = 1.0) -> None:
        self.factor = factor
        self.coordinates = (type("One", (), {"joint": "elbow", "body": None})(),)

    def widened(self, factors: list[float], name: str) -> Ranges:
        return Ranges(factors[0])


def found(monkeypatch: pytest.MonkeyPatch, ratio_of) -> tuple[float, dict]:
    """The factor of the ranges whose deviations have the ratio ``ratio_of(factor)``."""
    monkeypatch.setattr(
        widening,
        "deviations",
        lambda traces, noise, share: {"elbow": Deviation(ratio_of(traces), 0.0)},
    )
    ranges, said = widen(Ranges(), lambda one: one.factor, {}, {}, 0.95)
    return ranges.factor, said


def test_a_joint_whose_deviations_grow_with_its_ranges_gets_the_ratio(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    factor, said = found(monkeypatch, lambda factor: 4.0 / factor)
    assert factor == pytest.approx(4.0)
    assert not said["unexplained"]


def test_ranges_that_lock_the_joint_when_they_grow_are_not_the_widest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Beyond a factor of 6 half of the robots stand still."""
    factor, said = found(
        monkeypatch, lambda factor: 8.0 / factor if factor < 6.0 else 100.0 * np.sqrt(factor)
    )
    assert 1.0 < factor < 6.0
    assert said["unexplained"] == ["elbow"]


def test_a_few_draws_are_enough_robots_to_widen_every_joint(tmp_path: Path) -> None:
    """Four draws of two joints: with four robots no p-value could be below the level of a joint."""
    assert fewest_robots(2) == 10
    twin = make_twin(tmp_path, [record(covariance(0.2))])
    (tmp_path / "recordings").mkdir()
    robot = true_arm(MEANS + np.array([2.0, 2.0, 0, 2.0, 2.0, 0, 0, 0]) * STD)
    rng = np.random.default_rng(4)
    for name, role in (("a", "held_out"), ("b", "final")):
        path = tmp_path / f"recordings/{name}.mcap"
        record_motion(path, robot, rng, seconds=2.0, role=role)
    found = ranges_of_file(str(twin), {"draws": 4})
    assert found["widening"]["factors"]["elbow"] > 2.0
    assert (
        "4 robots are too few to find ranges wider than need be: draw at least 50"
        in (found["notes"])
    )
