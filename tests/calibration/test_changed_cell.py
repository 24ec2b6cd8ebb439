"""A target, camera or size that changes between the observations is named, and never accepted."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cells
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.plan import Accept, HoldOut
from pytest_twin.metrics.pose import inverse, rigid

PLAN = cells.plan("hand_eye", "base_world", accept=Accept(0.002, 0.004), hold_out=HoldOut(0.33, 1))
OFFSET = rigid(Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix(), [0.012, 0.004, 0.0])
ORDER = np.arange(30)


def cell_of(rows: int, seed: int = 5, mount: str = "hand") -> cells.Cell:
    rng = np.random.default_rng(seed)
    return cells.flange_cell(
        rng, np.array([cells.pose(rng, 0.4) for _ in range(rows)]), mount=mount
    )


def calibrated(poses: np.ndarray, cell: cells.Cell) -> dict[str, Any]:
    return calibrate(PLAN, replace(cell.observations, camera_from_target=poses), None)


@pytest.mark.parametrize("rows", [ORDER % 2 == 1, (ORDER >= 10) & (ORDER < 20)])
def test_a_second_camera_is_named_with_its_rows(rows: np.ndarray) -> None:
    cell = cell_of(30)
    poses = cell.observations.camera_from_target.copy()
    poses[rows] = inverse(OFFSET) @ poses[rows]
    found = calibrated(poses, cell)
    assert found["verdict"] == "rejected"
    assert "agree with each other and not with the others" in found["reasons"][0]
    assert "the camera on the flange is elsewhere" in found["reasons"][0]
    assert "there are two of them" in found["reasons"][0]


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (ORDER % 2 == 1, "of 30 observations agree with each other"),
        (ORDER >= 12, "from observation 12 on, the target is "),
    ],
)
def test_targets_of_two_sizes_are_named_with_the_factor(rows: np.ndarray, words: str) -> None:
    cell = cell_of(30)
    poses = cell.observations.camera_from_target.copy()
    poses[rows, :3, 3] *= 1.03
    found = calibrated(poses, cell)
    assert found["verdict"] == "rejected"
    assert words in found["reasons"][0]
    # Of two halves, either is the other one.
    factor = float(found["reasons"][0].split("the target is ")[1].split(" times")[0])
    assert max(factor, 1.0 / factor) == pytest.approx(1.03, abs=0.003)


@pytest.mark.parametrize("changed", ["target", "focus"])
def test_a_gradual_change_is_named_if_the_poses_have_a_random_order(changed: str) -> None:
    cell = cell_of(30)
    poses = cell.observations.camera_from_target.copy()
    if changed == "target":
        poses[:, :3, 3] += poses[:, :3, 2] * (0.008 * ORDER / 29.0)[:, None]
    else:
        poses[:, :3, 3] *= (1.0 + 0.02 * ORDER / 29.0)[:, None]
    found = calibrated(poses, cell)
    words = {
        "target": "the target in the base gradually moves by about 8",
        "focus": "gradually gets 1.02",
    }[changed]
    assert found["verdict"] == "rejected"
    assert words in found["reasons"][0]


def test_a_gradual_change_along_a_path_is_noted_with_the_other_explanation() -> None:
    cell = cell_of(30, seed=0)
    order = np.argsort(cell.observations.flange[:, 2, 3])
    observations = cell.observations.rows(order)
    # Poses along a line, each near the one before it.
    flange = observations.flange.copy()
    flange[:, :2, 3] = 0.4
    poses = cells.seen(flange, cell.mounted, cell.world, "hand")
    poses = cells.noisy(poses, 5e-4, 1e-3, np.random.default_rng(1))
    poses[:, :3, 3] += poses[:, :3, 2] * (0.006 * ORDER / 29.0)[:, None]
    found = calibrate(PLAN, replace(observations, flange=flange, camera_from_target=poses), None)
    assert any("take the poses in a random order" in note for note in found["notes"])


@pytest.mark.parametrize("seed", range(6))
def test_a_cell_that_does_not_change_is_accepted(seed: int) -> None:
    cell = cell_of(30, seed)
    poses = cell.observations.camera_from_target.copy()
    # Single wrong detections do not agree with each other.
    rng = np.random.default_rng(seed)
    poses[rng.permutation(30)[:6], :3, 3] += rng.normal(0.0, 0.05, (6, 3))
    found = calibrated(poses, cell)
    assert found["suspected"] == []
    assert not any("gradually" in note for note in found["notes"])


@pytest.mark.parametrize(
    ("mount", "row", "shift", "words"),
    [
        ("hand", 18, [0.03, 0.02, 0.0], "the target in the base"),
        ("hand", 15, [0.005, 0.0, 0.0], "the target in the base"),
        ("world", 9, [0.0, 0.01, 0.01], "the target on the flange"),
    ],
)
def test_a_body_that_moved_is_named_with_the_row(
    mount: str, row: int, shift: list[float], words: str
) -> None:
    observations = cell_of(30, mount=mount).observations
    poses = observations.camera_from_target.copy()
    poses[row:] = poses[row:] @ rigid(Rotation.from_rotvec([0, 0, 0.02]).as_matrix(), shift)
    # A wrong row does not hide the step.
    poses[4, :3, 3] += 0.3
    plan = replace(PLAN, mount=mount)
    found = calibrate(plan, replace(observations, camera_from_target=poses), None)
    assert found["verdict"] == "rejected"
    assert found["reasons"][0].startswith(f"from observation {row} on, {words} is elsewhere")
    assert f"after observation {row - 1}" in found["reasons"][0]
    size = 1e3 * np.linalg.norm(shift)
    assert float(found["reasons"][0].split("by about ")[1].split(" mm")[0]) == pytest.approx(
        size, rel=0.3
    )


@pytest.mark.parametrize("seed", range(4))
def test_wrong_joint_zeros_are_no_moved_body(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cell = cells.joint_cell(rng, cells.arm(6, rng), 40, zeros=rng.normal(0.0, 0.02, 6))
    # The poses follow a path along the first joint.
    order = np.argsort(cell.observations.joints["j1"])
    along = cell.observations.rows(order)
    found = calibrate(cells.plan("hand_eye"), along, cell.chain)
    assert not any("is elsewhere" in one["what"] for one in found["suspected"])
