"""Homographies of a flat board."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.opencv import opencv


def fit_homography(plane: FloatArray, pixels: FloatArray) -> FloatArray | None:
    """(3, 3) homography from the board's plane to the image; None if no homography fits.

    Args:
        plane: (n, 2) positions on the board, m.
        pixels: (n, 2) positions in the image, px.
    """
    scale = float(np.ptp(plane, axis=0).max())
    if len(plane) < 4 or scale <= 0.0:
        return None
    homography, _ = opencv().findHomography(plane / scale, pixels, method=0)
    if homography is None or not np.isfinite(homography).all():
        return None
    return np.asarray(homography @ np.diag([1.0 / scale, 1.0 / scale, 1.0]), dtype=np.float64)


def project(homography: FloatArray, plane: FloatArray) -> FloatArray:
    """(n, 2) image positions, px, of (n, 2) positions on the board, m; NaN behind the camera."""
    mapped = np.column_stack([plane, np.ones(len(plane))]) @ homography.T
    depth = np.where(np.abs(mapped[:, 2:]) > 1e-12, mapped[:, 2:], np.nan)
    return np.asarray(mapped[:, :2] / depth, dtype=np.float64)
