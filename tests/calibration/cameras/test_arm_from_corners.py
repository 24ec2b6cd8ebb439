"""Joint least-squares estimation of joint zeros, links, camera and frames from corner pixels."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1]))
import cells
from nightly import samples

from pytest_twin.calibration.boards.detection import Detection
from pytest_twin.calibration.boards.target import make_target
from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.cameras.arm import arm_of
from pytest_twin.calibration.cameras.images import Images
from pytest_twin.calibration.cameras.increments import apply_change, by_measured, difference
from pytest_twin.calibration.cameras.intrinsics import make_intrinsics
from pytest_twin.calibration.chain import link_parameters
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Priors
from pytest_twin.calibration.problem import make_problem
from pytest_twin.metrics.pose import inverse, rigid

CAMERA = make_intrinsics({"fx": 900.0, "fy": 905.0, "cx": 510.0, "cy": 378.0})
TARGET = make_target({"kind": "chessboard", "squares": [8, 5], "square": 0.04})
PIXEL, POSITION, TURN = 0.2, 1e-4, 2e-4
PRIORS = Priors(geometry_translation=5e-4, geometry_rotation=2e-3)


def random_cell(
    seed: int, rows: int, *, links: bool
) -> tuple[cells.Cell, Images, dict[str, float]]:
    """A robot with wrong joint zeros and corners of a board in its camera, projected by OpenCV."""
    rng = np.random.default_rng(seed)
    chain = cells.arm(6, rng)
    true = chain
    deviations: dict[str, float] = {}
    if links:
        placements = chain.placements.copy()
        for link in link_parameters(chain, 1):
            prior = PRIORS.geometry_rotation if link.is_rotation else PRIORS.geometry_translation
            value = float(rng.normal(0.0, prior))
            deviations[link.label] = value
            turn = Rotation.from_rotvec(value * link.direction * link.is_rotation).as_matrix()
            shift = value * link.direction * (not link.is_rotation)
            placements[link.joint] = placements[link.joint] @ rigid(turn, shift)
        true = replace(chain, placements=placements)
    # The zeros of the first and last joint are not observable with unknown base and camera poses.
    zeros = np.r_[0.0, rng.normal(0.0, 0.01, 4), 0.0]
    middle = rng.uniform(-0.5, 0.5, 6)
    turn = Rotation.from_rotvec(rng.normal(0.0, 0.2, 3)).as_matrix()
    mounted = rigid(turn, rng.uniform(-0.05, 0.05, 3))
    ahead = rigid(np.eye(3), [-0.14, -0.08, 0.6])
    world = cells.forward(true, middle[None] + zeros)[0] @ mounted @ ahead
    points = TARGET.board_points()
    readings, detections = [], {}
    while len(readings) < rows:
        here = middle + rng.uniform(-0.9, 0.9, 6)
        flange = cells.forward(true, here[None] + zeros)[0]
        noise = np.r_[rng.normal(0, POSITION, 3), rng.normal(0, TURN, 3)]
        flange = flange @ apply_change(np.eye(4), noise)
        seen = inverse(flange @ mounted) @ world
        corners = points @ seen[:3, :3].T + seen[:3, 3]
        if corners[:, 2].min() < 0.25 or corners[:, 2].max() > 1.2 or seen[2, 2] < 0.5:
            continue
        turned = Rotation.from_matrix(seen[:3, :3]).as_rotvec()
        pixels, _ = cv2.projectPoints(points, turned, seen[:3, 3], CAMERA.matrix, None)
        pixels = pixels.reshape(-1, 2) + rng.normal(0.0, PIXEL, (len(points), 2))
        if pixels.min() < -1500.0 or pixels.max() > 2500.0:
            continue
        name, ids = str(len(readings)), np.arange(len(points))
        detections[name] = Detection(name, (1024, 768), ids, pixels, points, len(points), 0.6)
        readings.append(here)
    names = tuple(detections)
    joints = dict(zip(chain.joints, np.array(readings).T, strict=True))
    cell = cells.Cell(mounted, world, Observations(ids=names, joints=joints), chain, zeros)
    files = dict.fromkeys(names, "")
    return cell, Images(TARGET, detections, (), files, CAMERA, is_estimated=False), deviations


def solved(cell: cells.Cell, images: Images, *estimate: str) -> dict:
    plan = cells.plan(*estimate, "hand_eye", "robot_world", priors=PRIORS)
    return calibrate(plan, cell.observations, cell.chain, images=images)


def is_inside(stated: dict, truth: float) -> bool:
    return bool(stated["ci95"][0] <= truth <= stated["ci95"][1])


@pytest.mark.parametrize("seeds", samples(3, always=(0,)))
@pytest.mark.parametrize("links", [False, True])
def test_intervals_of_zeros_links_and_frames_contain_the_true_values(
    links: bool, seeds: tuple[int, ...]
) -> None:
    zeros, frames, geometry = [], [], []
    for seed in seeds:
        cell, images, deviations = random_cell(seed, 30, links=links)
        asked = ("joint_zeros", "geometry") if links else ("joint_zeros",)
        found = solved(cell, images, *asked)
        assert found["verdict"] == "accepted"
        assert found["fitted"]["noise"]["reprojection"] == pytest.approx(PIXEL, rel=0.1)
        stated = found["records"]["joint_zeros"]["values"]
        for name, truth in zip(cell.chain.joints, cell.zeros, strict=True):
            if name in stated:
                zeros.append(is_inside(stated[name], truth))
        frames += cells.truth_inside(found, "hand_eye", cell.mounted)
        frames += cells.truth_inside(found, "robot_world", cell.world)
        if links:
            values = found["records"]["geometry"]["values"]
            geometry += [is_inside(values[name], deviations[name]) for name in values]
    # The intervals of one cell are correlated, so the bound is 85 % instead of 95 %.
    assert len(zeros) == 4 * len(seeds)
    assert np.mean(zeros + frames) >= 0.85
    if links:
        assert np.mean(geometry) >= 0.85


def test_derivatives_by_joint_zeros_and_links_agree_with_finite_differences() -> None:
    cell, _, _ = random_cell(7, 5, links=True)
    plan = cells.plan("joint_zeros", "geometry", "hand_eye", priors=PRIORS)
    poses = np.array([cells.pose(np.random.default_rng(seed)) for seed in range(5)])
    observations = replace(cell.observations, camera_from_target=poses)
    problem = make_problem(plan, observations, cell.chain)
    arm = arm_of(problem, np.arange(5), problem.fixed)
    assert arm is not None
    rng = np.random.default_rng(8)
    at = rng.normal(0.0, 0.02, arm.count)
    flange, change = arm.flange(at)
    predicted = flange @ np.array([cells.pose(rng, 0.01) for _ in range(5)])
    _, slope = difference(flange, predicted)
    slopes = by_measured(flange, predicted, slope) @ change
    for column in range(arm.count):
        step = 1e-6 * np.eye(arm.count)[column]
        after, before = (difference(arm.flange(at + s)[0], predicted)[0] for s in (step, -step))
        assert np.allclose(slopes[:, :, column], (after - before) / 2e-6, atol=1e-6)
