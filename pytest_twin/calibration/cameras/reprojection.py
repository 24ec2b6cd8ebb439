"""Reprojection residuals of detected corners, with derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.detection import Detection
from pytest_twin.calibration.cameras.intrinsics import project
from pytest_twin.calibration.transform_derivatives import skew


@dataclass(frozen=True)
class Corners:
    """Detected corners of several images in one table.

    Attributes:
        image: (m,) index of the image of each corner, ascending.
        pixels: (m, 2) detected positions, px.
        points: (m, 3) positions in the target's frame, m.
        ids: (m,) index of each corner on the target.
        images: number of images; each has corners.
    """

    image: np.ndarray
    pixels: FloatArray
    points: FloatArray
    ids: np.ndarray
    images: int

    @property
    def starts(self) -> np.ndarray:
        """(images,) index of the first corner of each image."""
        return np.searchsorted(self.image, np.arange(self.images))


def corners_of(detections: Sequence[Detection]) -> Corners:
    """Collect the corners of detections, which must all be usable."""
    counts = [len(d.corner_ids) for d in detections]
    return Corners(
        np.repeat(np.arange(len(counts)), counts),
        np.concatenate([d.pixels for d in detections]),
        np.concatenate([d.board_points for d in detections]),
        np.concatenate([d.corner_ids for d in detections]),
        len(counts),
    )


def reprojection_residuals(
    intrinsics: FloatArray, camera_from_target: FloatArray, corners: Corners
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Predicted minus detected pixels, with derivatives.

    Args:
        intrinsics: (16,) in the order of ``intrinsics.NAMES``.
        camera_from_target: (images, 4, 4), m.

    Returns:
        (m, 2) residuals, px; (m, 2, 6) derivatives by a change of the image's
        ``camera_from_target`` (see ``increments``: m, then rad, in the camera's axes); (m, 2, 16)
        derivatives by the intrinsics.
    """
    poses = camera_from_target[corners.image]
    arms = np.einsum("nij,nj->ni", poses[:, :3, :3], corners.points)
    pixels, by_point, by_intrinsics = project(arms + poses[:, :3, 3], intrinsics)
    by_pose = np.concatenate([by_point, -by_point @ skew(arms)], axis=2)
    return pixels - corners.pixels, by_pose, by_intrinsics
