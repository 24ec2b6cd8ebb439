"""An arm that bends under gravity: said, and the intervals contain the truth."""

from __future__ import annotations

from itertools import pairwise

import cells
import numpy as np
import pytest

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import HoldOut
from pytest_twin.realization.serial_chain import SerialChain

HAND_EYE = ("hand_eye", "base_world")
ARM_STIFFNESS = 2500.0
"""N*m/rad at most of the first joint; the others are softer. The flange sinks by up to 5 mm."""


def torque_of_gravity(chain: SerialChain, values: np.ndarray, masses: np.ndarray) -> np.ndarray:
    """(rows, joints) N*m of masses in the middle of each link and at the flange."""
    torques = np.zeros(values.shape)
    for row, pose in enumerate(values):
        places, axes, total = [], [], np.eye(4)
        for at, value in enumerate(pose):
            total = total @ chain.placements[at]
            places.append(total[:3, 3])
            axes.append(total[:3, :3] @ chain.axes[at])
            c, s = np.cos(value), np.sin(value)
            turn = np.eye(4)
            turn[:2, :2] = [[c, -s], [s, c]]
            total = total @ turn
        places.append((total @ chain.end)[:3, 3])
        middles = [0.5 * (a + b) for a, b in pairwise(places)]
        for joint, axis in enumerate(axes):
            for mass, place in zip(masses[joint:], [*middles, places[-1]][joint:], strict=True):
                force = np.array([0.0, 0.0, -9.81 * mass])
                torques[row, joint] += axis @ np.cross(place - places[joint], force)
    return torques


def calibrated(seed: int, compliance: float, zeros: float = 0.0) -> tuple[dict, np.ndarray]:
    """Result for an arm with this compliance, rad/(N*m), and wrong zeros, rad; the true camera."""
    rng = np.random.default_rng(seed)
    chain = cells.arm(6, rng)
    readings = rng.uniform(-1.2, 1.2, (30, 6))
    torques = torque_of_gravity(chain, readings, rng.uniform(0.5, 3.0, 7))
    soft = compliance * rng.uniform(0.3, 1.0, 6) * [1.0, 1.0, 1.5, 3.0, 3.0, 3.0]
    moved = readings + soft * torques + zeros * np.array([0.0, 1.0, -1.0, 1.0, -1.0, 0.0])
    cell = cells.flange_cell(rng, cells.forward(chain, moved))
    observations = Observations(
        ids=cell.observations.ids,
        joints=dict(zip(chain.joints, readings.T, strict=True)),
        camera_from_target=cell.observations.camera_from_target,
    )
    plan = cells.plan(*HAND_EYE, hold_out=HoldOut(0.33, 1))
    return calibrate(plan, observations, chain), cell.mounted[:3, 3]


def holds(document: dict, truth: np.ndarray) -> list[bool]:
    spans = document["records"]["hand_eye"]["ci95"]
    return [
        spans[axis][0] <= value <= spans[axis][1] for axis, value in zip("xyz", truth, strict=True)
    ]


def note_of(document: dict) -> str:
    return next((note for note in document["notes"] if "torque of gravity" in note), "")


def test_the_intervals_of_an_arm_that_bends_contain_the_true_camera() -> None:
    """Without the test, 69 % of those of twelve other arms did: the camera was up to 6 mm off."""
    inside = []
    for seed in range(6):
        document, truth = calibrated(seed, 1.0 / ARM_STIFFNESS)
        assert "the arm bends, by about" in note_of(document)
        assert document["fitted"]["compliance"]["probability"] < 1e-3
        inside += holds(document, truth)
    assert np.mean(inside) >= 16 / 18


def test_nothing_is_said_of_a_stiff_arm() -> None:
    inside = []
    for seed in range(6):
        document, truth = calibrated(seed, 0.0)
        assert note_of(document) == ""
        assert "compliance" not in document["fitted"]
        inside += holds(document, truth)
    assert np.mean(inside) >= 15 / 18


@pytest.mark.parametrize("seed", [0, 1])
def test_wrong_zeros_are_not_called_compliance(seed: int) -> None:
    document, _ = calibrated(seed, 0.0, zeros=0.01)
    assert "by about" not in note_of(document)
