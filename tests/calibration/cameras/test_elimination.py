"""Normal equations with one family of blocks eliminated, against dense algebra and OpenCV."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.boards.detection import Detection
from pytest_twin.calibration.boards.target import make_target
from pytest_twin.calibration.cameras.camera_calibration import calibrate_camera
from pytest_twin.calibration.cameras.elimination import BlockMatrix, Elimination, Step
from pytest_twin.calibration.cameras.intrinsics import make_intrinsics

SHARED = 5


def drawn_matrix(poses: int, corners: int) -> tuple[BlockMatrix, np.ndarray]:
    """A matrix in blocks, and the same as a dense one."""
    rng = np.random.default_rng(poses)
    size = SHARED + 6 * poses + 3 * corners
    rows = []
    for pose in range(poses):
        for corner in range(corners):
            row = np.zeros((2, size))
            row[:, :SHARED] = rng.normal(size=(2, SHARED))
            row[:, SHARED + 6 * pose :][:, :6] = rng.normal(size=(2, 6))
            row[:, SHARED + 6 * poses + 3 * corner :][:, :3] = rng.normal(size=(2, 3))
            rows.append(row)
    jacobian = np.concatenate(rows)
    dense = jacobian.T @ jacobian + np.eye(size)
    split = SHARED + 6 * poses
    pose_part, corner_part = dense[SHARED:split, SHARED:split], dense[split:, split:]
    return BlockMatrix(
        dense[:SHARED, :SHARED],
        np.array([pose_part[i : i + 6, i : i + 6] for i in range(0, 6 * poses, 6)]),
        np.array([corner_part[i : i + 3, i : i + 3] for i in range(0, 3 * corners, 3)]),
        dense[:SHARED, SHARED:split],
        dense[:SHARED, split:],
        dense[SHARED:split, split:],
    ), dense


@pytest.mark.parametrize(("poses", "corners"), [(3, 9), (7, 4)])
def test_steps_and_covariances_agree_with_dense_algebra(poses: int, corners: int) -> None:
    blocks, dense = drawn_matrix(poses, corners)
    found = Elimination(blocks)
    assert found.eliminates_corners == (3 * corners >= 6 * poses)
    right = np.random.default_rng(1).normal(size=len(dense))
    split = SHARED + 6 * poses
    step = found.step(
        Step(right[:SHARED], right[SHARED:split].reshape(-1, 6), right[split:].reshape(-1, 3)), 0.0
    )
    expected = -np.linalg.solve(dense, right)
    np.testing.assert_allclose(
        np.concatenate([step.shared, step.poses.ravel(), step.corners.ravel()]), expected, rtol=1e-8
    )
    inverse = np.linalg.inv(dense)
    np.testing.assert_allclose(found.covariance.shared, inverse[:SHARED, :SHARED], rtol=1e-8)
    np.testing.assert_allclose(
        found.covariance.shared_poses, inverse[:SHARED, SHARED:split], rtol=1e-7, atol=1e-12
    )
    for at in range(poses):
        place = slice(SHARED + 6 * at, SHARED + 6 * at + 6)
        np.testing.assert_allclose(found.covariance.poses[at], inverse[place, place], rtol=1e-8)
    for at in range(corners):
        place = slice(split + 3 * at, split + 3 * at + 3)
        np.testing.assert_allclose(found.covariance.corners[at], inverse[place, place], rtol=1e-8)


def test_28_images_of_24_x_17_corners_take_seconds_and_agree_with_opencv() -> None:
    true = make_intrinsics({"fx": 1300.0, "fy": 1305.0, "cx": 640.0, "cy": 480.0,
                            "distortion": [-0.1, 0.05, 0.001, -0.002, 0.0]})  # fmt: skip
    target = make_target({"kind": "chessboard", "squares": [25, 18], "square": 0.012})
    points = target.board_points()
    rng = np.random.default_rng(0)
    detections = []
    for number in range(28):
        turn = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.3, 0.3)])
        place = [*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.4, 0.6)]
        place = place - Rotation.from_rotvec(turn).apply(points.mean(axis=0))
        pixels, _ = cv2.projectPoints(points, turn, place, true.matrix, true.distortion)
        pixels = pixels.reshape(-1, 2) + rng.normal(0.0, 0.1, (len(points), 2))
        ids = np.arange(len(points))
        detections.append(Detection(str(number), (1280, 960), ids, pixels, points, len(ids), 0.6))
    start = time.process_time()
    camera = calibrate_camera(detections, points, None)
    # 2 s on one thread; with the board's corners in a dense Jacobian it was more than 300 s.
    assert time.process_time() - start < 60.0
    _, matrix, _, _, _ = cv2.calibrateCamera(
        [points.astype(np.float32)] * 28, [one.pixels.astype(np.float32) for one in detections],
        (1280, 960), None, None,
    )  # fmt: skip
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    spread = np.sqrt(np.diag(camera.covariance))[:4]
    assert (np.abs(camera.intrinsics.vector[:4] - true.vector[:4]) < 4.0 * spread).all()
    # OpenCV estimates k3 too, so its estimates scatter more.
    np.testing.assert_allclose(camera.intrinsics.vector[:4], theirs, atol=0.5)
    assert camera.pixel_noise == pytest.approx(0.1, rel=0.05)
