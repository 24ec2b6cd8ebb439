"""Calibrate the intrinsics of a camera from images of a target, without robot poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.detection import Detection
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.calibration.cameras.bundle import Bundle, KnownNoise, bundle
from pytest_twin.calibration.cameras.intrinsics import COUNT, Intrinsics
from pytest_twin.calibration.cameras.normal_equations import Unknowns
from pytest_twin.calibration.cameras.pose import target_pose
from pytest_twin.errors import SpecError
from pytest_twin.time_limit import is_over

PINHOLE = ("fx", "fy", "cx", "cy")

MODELS = (
    PINHOLE,
    (*PINHOLE, "k1"),
    (*PINHOLE, "k1", "k2"),
    (*PINHOLE, "k1", "k2", "p1", "p2"),
    (*PINHOLE, "k1", "k2", "p1", "p2", "k3"),
)
"""Distortion models that are compared. Each model extends the one before it."""

FEWEST_IMAGES = 3
"""Smallest number of images that determine all intrinsic parameters of a planar target (Zhang
2000)."""


@dataclass(frozen=True)
class Camera:
    """A camera and the board that it was calibrated with.

    Attributes:
        intrinsics: estimated or given intrinsics.
        board: (corners, 3) positions of the board's corners in its frame, m.
        free: names of the intrinsics that were estimated.
        covariance: (free, free) covariance of the free intrinsics.
        pixel_noise: standard deviation of a corner's coordinate, px.
        board_noise: standard deviation of a corner's position on the board against its drawing, m;
            0 if the drawing was assumed exact.
    """

    intrinsics: Intrinsics
    board: FloatArray
    free: tuple[str, ...]
    covariance: FloatArray
    pixel_noise: float
    board_noise: float


def calibrate_camera(
    detections: Sequence[Detection], board: FloatArray, start: Intrinsics | None
) -> Camera:
    """Estimate the camera from images, with the distortion model that the images support.

    The model of ``MODELS`` with the smallest Bayesian information criterion is selected.

    Args:
        detections: usable detections of one camera.
        board: (corners, 3) corners of the board's drawing, m.
        start: initial intrinsics; by default they are estimated from the images.

    Raises:
        SpecError: too few images, images of different sizes, or views that do not determine the
            camera.
    """
    _check(detections)
    vector = first_guess(detections) if start is None else start.vector
    best: Bundle | None = None
    before: Bundle | None = None
    least = np.inf
    for free in MODELS:
        if best is not None and is_over():
            break
        try:
            found = fit_images(detections, board, Intrinsics(vector), free, before)
        except (np.linalg.LinAlgError, ValueError, FloatingPointError):
            continue
        before = found
        count = found.residuals.size
        squares = float(np.sum(found.residuals**2))
        criterion = count * np.log(squares / count) + len(free) * np.log(count)
        if np.isfinite(criterion) and criterion < least:
            best, least = found, criterion
        vector = found.intrinsics
    if best is None:
        raise SpecError(
            "the images do not determine the camera's intrinsics",
            where="camera.intrinsics",
            value=f"{len(detections)} images",
            expected="views of the target that are tilted by 20 to 50 degrees in several "
            "directions, or given intrinsics",
        )
    return camera_of(best)


def fit_images(
    detections: Sequence[Detection],
    board: FloatArray,
    intrinsics: Intrinsics,
    free: Sequence[str],
    before: Bundle | None = None,
) -> Bundle:
    """Fit the images alone with some intrinsics free and the others fixed.

    Args:
        detections: usable detections of one camera.
        board: (corners, 3) corners of the board's drawing, m.
        intrinsics: initial values of the free intrinsics and values of the fixed ones.
        free: names of the free intrinsics.
        before: earlier result of the same images to start from.

    Raises:
        ValueError: an image in which no pose of the target is found.
        numpy.linalg.LinAlgError: the images do not determine the unknowns.
    """
    if before is not None:
        start = Unknowns(np.eye(4), np.eye(4), intrinsics.vector, before.camera_from_target, board)
        known = KnownNoise(before.noise, is_exact=False)
        return bundle(None, detections, start, free, noise=known)
    poses = [target_pose(one, intrinsics) for one in detections]
    if any(pose is None for pose in poses):
        raise ValueError("no pose of the target")
    seen = np.array([pose.camera_from_target for pose in poses if pose is not None])
    start = Unknowns(np.eye(4), np.eye(4), intrinsics.vector, seen, board)
    return bundle(None, detections, start, free)


def camera_of(found: Bundle) -> Camera:
    """Return the camera and board of a bundle adjustment."""
    return Camera(
        Intrinsics(found.intrinsics),
        found.board,
        found.free,
        found.covariance[-len(found.free) :, -len(found.free) :]
        if found.free
        else np.zeros((0, 0)),
        found.noise.pixel,
        found.noise.board if found.is_board_estimated else 0.0,
    )


def first_guess(detections: Sequence[Detection]) -> FloatArray:
    """(16,) intrinsics without distortion from the vanishing points of flat targets (Zhang)."""
    cv2 = opencv()
    matrix = cv2.initCameraMatrix2D(
        [one.board_points.astype(np.float32) for one in detections],
        [one.pixels.astype(np.float32) for one in detections],
        detections[0].size,
        1.0,
    )
    vector = np.zeros(COUNT)
    width, height = detections[0].size
    focal = [float(matrix[0, 0]), float(matrix[1, 1])]
    if not all(np.isfinite(f) and 0.1 * width < f < 50.0 * width for f in focal):
        focal = [1.2 * width, 1.2 * width]
    vector[:4] = [*focal, (width - 1) / 2.0, (height - 1) / 2.0]
    return vector


def _check(detections: Sequence[Detection]) -> None:
    if len(detections) < FEWEST_IMAGES:
        raise SpecError(
            "too few images to estimate intrinsics",
            where="camera.intrinsics",
            value=len(detections),
            expected=f"at least {FEWEST_IMAGES} usable images, or given intrinsics",
        )
    sizes = {one.size for one in detections}
    if len(sizes) > 1:
        raise SpecError(
            "images of different sizes are not of one camera",
            where="observations",
            value=", ".join(f"{w} x {h}" for w, h in sorted(sizes)),
            unit="px",
            expected="one size",
        )
