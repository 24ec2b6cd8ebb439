"""Factors by which ranges grow where held-out recordings deviate more than is predicted."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.ranges import widening
from pytest_twin.ranges.widening import Deviation, widened


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
    ranges, said = widened(Ranges(), lambda one: one.factor, {}, {}, 0.95)
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
