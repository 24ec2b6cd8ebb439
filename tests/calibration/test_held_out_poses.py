"""Held-out poses that test only a part of the calibration are noted."""

from __future__ import annotations

from dataclasses import replace

import cells
import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Accept, HoldOut
from pytest_twin.metrics.pose import rigid

HELD_OUT = tuple(str(row) for row in range(20, 30))


def notes_of(observations: Observations, *estimate: str, **options: object) -> list[str]:
    plan = cells.plan(
        *estimate, accept=Accept(0.002, 0.004), hold_out=HoldOut(ids=HELD_OUT), **options
    )
    found = calibrate(plan, observations, None)
    assert found["verdict"] == "accepted", found["reasons"]
    return [note for note in found["notes"] if "do not test everything" in note]


def test_held_out_poses_about_one_axis_are_noted_with_what_they_do_not_test() -> None:
    rng = np.random.default_rng(4)
    general = np.array([cells.pose(rng, 0.4) for _ in range(20)])
    turns = Rotation.from_rotvec(np.outer(np.linspace(-0.5, 0.5, 10), [0.0, 0.0, 1.0]))
    repeated = np.array([general[3] @ rigid(turn.as_matrix(), np.zeros(3)) for turn in turns])
    cell = cells.flange_cell(rng, np.concatenate([general, repeated]))
    notes = notes_of(cell.observations, "hand_eye", "base_world")
    assert any("position of the camera on the flange along z axis" in note for note in notes)
    assert all("hold out others" in note for note in notes)


def test_held_out_poses_from_many_sides_test_everything() -> None:
    rng = np.random.default_rng(5)
    flange = np.array([cells.pose(rng, 0.4) for _ in range(30)])
    assert notes_of(cells.flange_cell(rng, flange).observations, "hand_eye", "base_world") == []


def test_held_out_markers_from_many_sides_test_everything() -> None:
    rng = np.random.default_rng(6)
    cell = cells.flange_cell(rng, np.array([cells.pose(rng, 0.4) for _ in range(30)]))
    # The target's origin is a marker that the tracker measures.
    tracked = np.linalg.inv(cell.world) @ cell.observations.flange @ cell.mounted
    points = tracked[:, :3, 3] + rng.normal(0.0, 2e-4, (30, 3))
    observations = replace(cell.observations, camera_from_target=None, points={"tip": points})
    assert notes_of(observations, "base_world", "tcp") == []
