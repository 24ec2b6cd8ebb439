"""A record that is written and read again reproduces the held-out errors of the calibration."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cells
import numpy as np
import pytest
from test_points import (
    PLACES,
    marker_observations,
    pivot_observations,
    random_rotations,
    touched_observations,
)

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import HoldOut, Plan
from pytest_twin.calibration.problem import make_problem
from pytest_twin.calibration.record_prediction import held_out_observations, recorded_state
from pytest_twin.calibration.residual_errors import errors_of
from pytest_twin.formats.calibration_record import read_calibration_record
from pytest_twin.metrics.pose import rigid

HELD = HoldOut(0.3, 1)
Case = Callable[[np.random.Generator], tuple[Plan, Observations]]


def camera_on_hand(rng: np.random.Generator) -> tuple[Plan, Observations]:
    flange = np.array([rigid(r, rng.uniform(-0.3, 0.3, 3)) for r in random_rotations(rng, 25)])
    plan = cells.plan("hand_eye", "base_world", hold_out=HELD)
    return plan, cells.flange_cell(rng, flange).observations


def camera_in_world(rng: np.random.Generator) -> tuple[Plan, Observations]:
    flange = np.array([rigid(r, rng.uniform(-0.3, 0.3, 3)) for r in random_rotations(rng, 25)])
    # The pose of the target on the flange is not estimated by request.
    plan = cells.plan("hand_eye", mount="world", hold_out=HELD)
    return plan, cells.flange_cell(rng, flange, mount="world").observations


def pivot(rng: np.random.Generator) -> tuple[Plan, Observations]:
    return cells.plan("tcp", hold_out=HELD), pivot_observations(rng, random_rotations(rng, 25))


def fixture(rng: np.random.Generator) -> tuple[Plan, Observations]:
    place = rigid(np.eye(3), [0.5, 0.2, 0.1])
    return cells.plan("fixture", "tcp", hold_out=HELD), touched_observations(rng, place)


def known_markers(rng: np.random.Generator) -> tuple[Plan, Observations]:
    plan = cells.plan("tcp", "base_world", points=PLACES, hold_out=HELD)
    return plan, marker_observations(rng, PLACES)[0]


def unknown_markers(rng: np.random.Generator) -> tuple[Plan, Observations]:
    return cells.plan("base_world", hold_out=HELD), marker_observations(rng, PLACES)[0]


CASES: list[Case] = [
    camera_on_hand, camera_in_world, pivot, fixture, known_markers, unknown_markers,
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=[case.__name__ for case in CASES])
def test_held_out_errors_are_reproduced_from_the_record(tmp_path: Path, case: Case) -> None:
    plan, observations = case(np.random.default_rng(7))
    document = calibrate(plan, observations, None)
    assert document["verdict"] == "accepted"
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(document))
    record = read_calibration_record(path)
    held = held_out_observations(observations, record)
    problem = make_problem(plan, held, None)
    errors = errors_of(problem, recorded_state(problem, record)).summary()
    found = {name: value for name, value in errors.items() if name.endswith("_rms")}
    assert found == pytest.approx(dict(record.held_out), rel=1e-6)
