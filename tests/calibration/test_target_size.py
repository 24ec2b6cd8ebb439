"""A target of another size is rejected; its tolerance is in the intervals of all measurements."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cells
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.boards.detection import Detection
from pytest_twin.calibration.boards.target import make_target
from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.cameras.images import Images
from pytest_twin.calibration.cameras.intrinsics import make_intrinsics
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Accept, HoldOut, load_plan
from pytest_twin.errors import SpecError
from pytest_twin.metrics.pose import inverse, rigid

TOLERANCE = 0.002
BOARD = {"kind": "chessboard", "squares": [8, 5], "square": 0.03}
CAMERA = make_intrinsics({"fx": 900.0, "fy": 905.0, "cx": 510.0, "cy": 378.0})
ACCEPT = Accept(translation=0.002, rotation=0.004)


def near_cell(rng: np.random.Generator, mount: str, rows: int = 24) -> cells.Cell:
    """A camera at 0.4 to 0.5 m from its target, from many sides, without noise."""
    mounted = rigid(Rotation.from_rotvec(rng.uniform(-1, 1, 3)).as_matrix(), [0.03, -0.05, 0.08])
    world = cells.pose(rng, 0.6)
    views = []
    for _ in range(rows):
        turn = Rotation.from_rotvec([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-1.5, 1.5)])
        ahead = [*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.4, 0.5)]
        views.append(rigid(turn.as_matrix(), ahead - turn.apply([0.12, 0.09, 0.0])))
    seen = np.array(views)
    around = inverse(seen) if mount == "hand" else seen
    flange = world @ around @ inverse(mounted)
    ids = tuple(str(row) for row in range(rows))
    return cells.Cell(mounted, world, Observations(ids, flange=flange, camera_from_target=seen))


def with_poses(
    cell: cells.Cell, scale: float, rng: np.random.Generator, noise: float = 5e-4
) -> Observations:
    poses = cell.observations.camera_from_target.copy()
    poses[:, :3, 3] *= scale
    return replace(
        cell.observations, camera_from_target=cells.noisy(poses, noise, 2.0 * noise, rng)
    )


def with_corners(
    cell: cells.Cell, scale: float, rng: np.random.Generator
) -> tuple[Observations, Images]:
    """Corners of a printed board whose stated size is ``scale`` times the real one."""
    stated = make_target({**BOARD, "square": scale * BOARD["square"]})
    printed = make_target(BOARD).board_points()
    detections = {}
    for name, pose in zip(cell.observations.ids, cell.observations.camera_from_target, strict=True):
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        pixels, _ = cv2.projectPoints(printed, turn, pose[:3, 3], CAMERA.matrix, None)
        pixels = pixels.reshape(-1, 2) + rng.normal(0.0, 0.2, (len(printed), 2))
        ids = np.arange(len(printed))
        points = stated.board_points()
        detections[name] = Detection(name, (1024, 768), ids, pixels, points, len(ids), 0.6)
    flange = cells.noisy(cell.observations.flange, 2e-4, 5e-4, rng)
    observations = Observations(cell.observations.ids, flange=flange)
    files = dict.fromkeys(detections, "")
    return observations, Images(stated, detections, (), files, CAMERA, is_estimated=False)


def calibrated(kind: str, mount: str, scale: float, seed: int) -> tuple[cells.Cell, dict[str, Any]]:
    rng = np.random.default_rng(seed)
    cell = near_cell(rng, mount)
    images = None
    if kind == "images":
        observations, images = with_corners(cell, scale, rng)
    else:
        observations = with_poses(cell, scale, rng)
    plan = cells.plan(
        "hand_eye", "robot_world", mount=mount, accept=ACCEPT, hold_out=HoldOut(0.2, 1)
    )
    return cell, calibrate(plan, observations, None, images=images)


@pytest.mark.parametrize(
    ("kind", "mount", "size"),
    [
        ("poses", "hand", 0.957),
        ("poses", "hand", 0.97),
        ("poses", "hand", 0.98),
        ("poses", "world", 0.97),
        ("poses", "world", 1.03),
        ("images", "hand", 0.98),
    ],
)
def test_a_target_of_another_size_is_rejected_with_the_factor(
    kind: str, mount: str, size: float
) -> None:
    _, found = calibrated(kind, mount, 1.0 / size, seed=3)
    assert found["verdict"] == "rejected"
    (mistake,) = found["suspected"]
    low, high = (float(one) for one in re.findall(r"95 %: (\S+) to (\S+)\)", mistake["what"])[0])
    assert low < 1.0 / size < high
    assert mistake["factor"] == pytest.approx(size, abs=0.006)
    assert "tolerance" in found["reasons"][0]


@pytest.mark.parametrize(
    ("kind", "mount"),
    [
        ("poses", "hand"),
        pytest.param("poses", "world", marks=pytest.mark.nightly),
        pytest.param("images", "hand", marks=pytest.mark.nightly),
        ("images", "world"),
    ],
)
def test_intervals_contain_the_true_values_for_targets_within_the_tolerance(
    kind: str, mount: str
) -> None:
    inside: list[bool] = []
    draws = np.random.default_rng(7).normal(1.0, TOLERANCE, 3 if kind == "images" else 8)
    for seed, scale in enumerate(draws.tolist()):
        cell, found = calibrated(kind, mount, scale, seed)
        assert found["verdict"] == "accepted", found["reasons"]
        name = "hand_eye" if mount == "hand" else "target"
        inside += cells.truth_inside(found, name, cell.mounted)
        name = "robot_world" if mount == "hand" else "hand_eye"
        inside += cells.truth_inside(found, name, cell.world)
    # The 12 intervals of a cell are correlated, so the bound is 85 % instead of 95 %.
    assert np.mean(inside) >= 0.85


def test_a_good_target_widens_the_intervals_by_its_tolerance_only() -> None:
    widths = {}
    for tolerance in (0.0, TOLERANCE):
        rng = np.random.default_rng(2)
        observations = with_poses(near_cell(rng, "hand"), 1.0, rng)
        plan = replace(cells.plan("hand_eye", accept=ACCEPT), target={"tolerance": tolerance})
        low, high = calibrate(plan, observations, None)["records"]["hand_eye"]["ci95"]["z"]
        widths[tolerance] = (high - low) / 2.0
    added = np.sqrt(widths[TOLERANCE] ** 2 - widths[0.0] ** 2)
    # At 0.45 m on average, 0.2 % is 0.9 mm.
    assert 0.0 < added < 2.1 * TOLERANCE * 0.5


def test_a_larger_tolerance_is_the_way_out_and_the_interval_contains_the_camera() -> None:
    rng = np.random.default_rng(4)
    cell = near_cell(rng, "hand")
    observations = with_poses(cell, 1.0 / 0.98, rng)
    plan = replace(cells.plan("hand_eye", accept=ACCEPT), target={"tolerance": 0.02})
    found = calibrate(plan, observations, None)
    assert found["verdict"] == "accepted"
    low, high = found["records"]["target_scale"]["ci95"]
    assert low < 1.0 / 0.98 < high
    assert np.mean(cells.truth_inside(found, "hand_eye", cell.mounted)) >= 5 / 6


def test_the_default_tolerance_is_said() -> None:
    _, found = calibrated("poses", "hand", 1.0, seed=1)
    assert any("differ from the stated one by 0.2 %" in note for note in found["notes"])
    assert found["records"]["target_scale"]["prior_std"] == TOLERANCE


def test_a_plan_states_the_tolerance_without_a_kind_of_target(tmp_path: Path) -> None:
    (tmp_path / "observations.csv").write_text("id,joint.a\n0,0.0\n")
    plan = tmp_path / "plan.yaml"
    plan.write_text(
        "calibration: cell\nobservations: observations.csv\nestimate: [hand_eye]\n"
        "target: {tolerance: 0.005}\n"
    )
    assert load_plan(plan).target_tolerance == 0.005
    plan.write_text(plan.read_text().replace("0.005", "-0.1"))
    with pytest.raises(SpecError, match="tolerance"):
        load_plan(plan)
