"""Intrinsics of a camera, and projection with derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import SpecError

NAMES = (
    *("fx", "fy", "cx", "cy"),
    *("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
)
"""Order of the intrinsics in a vector: pinhole parameters (px), then distortion in OpenCV's
order."""

COUNT = len(NAMES)


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with radial, tangential, rational and thin-prism distortion (OpenCV).

    Attributes:
        vector: (16,) values in the order of ``NAMES``.
    """

    vector: FloatArray

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) camera matrix, px."""
        fx, fy, cx, cy = self.vector[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> FloatArray:
        """(12,) coefficients as OpenCV orders them."""
        return self.vector[4:]


def make_intrinsics(data: Mapping[str, Any]) -> Intrinsics:
    """Read the intrinsics in ``camera.intrinsics`` of a plan.

    Raises:
        SpecError: a field is missing, a focal length is not positive, or the sensor is tilted,
            which is not supported.
    """
    where = "camera.intrinsics"
    for name in NAMES[:4]:
        if name not in data:
            raise SpecError("a field is missing", where=f"{where}.{name}", expected="a value in px")
    distortion = [float(value) for value in data.get("distortion", ())]
    if len(distortion) > COUNT - 4:
        if any(distortion[COUNT - 4 :]):
            raise SpecError(
                "distortion of a tilted sensor is not supported",
                where=f"{where}.distortion",
                value=f"{len(distortion)} coefficients",
                expected="k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4, at most",
            )
        distortion = distortion[: COUNT - 4]
    vector = np.zeros(COUNT)
    vector[:4] = [float(data[name]) for name in NAMES[:4]]
    vector[4 : 4 + len(distortion)] = distortion
    if not np.isfinite(vector).all() or (vector[:2] <= 0.0).any():
        raise SpecError(
            "not a camera",
            where=where,
            value=f"fx {vector[0]:g}, fy {vector[1]:g}",
            unit="px",
            expected="finite numbers and positive focal lengths",
        )
    return Intrinsics(vector)


def project(points: FloatArray, vector: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Project points in the camera's frame to pixels, with derivatives.

    Args:
        points: (n, 3) in the camera's frame (z forward), m.
        vector: (16,) intrinsics in the order of ``NAMES``.

    Returns:
        (n, 2) pixels, px; (n, 2, 3) derivatives by the points, px/m; (n, 2, 16) derivatives by the
        intrinsics, px per unit.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = vector
    depth = points[:, 2]
    x, y = points[:, 0] / depth, points[:, 1] / depth
    r2 = x * x + y * y
    r4, r6 = r2 * r2, r2 * r2 * r2
    up, down = 1.0 + k1 * r2 + k2 * r4 + k3 * r6, 1.0 + k4 * r2 + k5 * r4 + k6 * r6
    radial = up / down
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + s1 * r2 + s2 * r4
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + s3 * r2 + s4 * r4
    pixels = np.stack([fx * xd + cx, fy * yd + cy], axis=1)

    # Derivatives of the distortion by r2, then by x and y.
    d_up, d_down = k1 + 2.0 * k2 * r2 + 3.0 * k3 * r4, k4 + 2.0 * k5 * r2 + 3.0 * k6 * r4
    d_radial = (d_up - radial * d_down) / down
    prism_x, prism_y = s1 + 2.0 * s2 * r2, s3 + 2.0 * s4 * r2
    xx = radial + 2.0 * x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * prism_x
    xy = 2.0 * x * y * d_radial + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * y * prism_x
    yx = 2.0 * x * y * d_radial + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * x * prism_y
    yy = radial + 2.0 * y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * prism_y
    by_normal = np.stack(
        [np.stack([fx * xx, fx * xy], axis=1), np.stack([fy * yx, fy * yy], axis=1)], axis=1
    )
    zero = np.zeros_like(x)
    normal_by_point = np.stack(
        [
            np.stack([1.0 / depth, zero, -x / depth], axis=1),
            np.stack([zero, 1.0 / depth, -y / depth], axis=1),
        ],
        axis=1,
    )
    by_intrinsics = np.zeros((len(points), 2, COUNT))
    by_intrinsics[:, 0, 0], by_intrinsics[:, 1, 1] = xd, yd
    by_intrinsics[:, 0, 2] = by_intrinsics[:, 1, 3] = 1.0
    ups = np.stack([r2, r4, r6], axis=1) / down[:, None]
    for column, slope in zip((4, 5, 8), ups.T, strict=True):
        by_intrinsics[:, 0, column], by_intrinsics[:, 1, column] = fx * x * slope, fy * y * slope
    for column, slope in zip((9, 10, 11), (-radial[:, None] * ups).T, strict=True):
        by_intrinsics[:, 0, column], by_intrinsics[:, 1, column] = fx * x * slope, fy * y * slope
    by_intrinsics[:, 0, 6], by_intrinsics[:, 1, 6] = fx * 2 * x * y, fy * (r2 + 2 * y * y)
    by_intrinsics[:, 0, 7], by_intrinsics[:, 1, 7] = fx * (r2 + 2 * x * x), fy * 2 * x * y
    by_intrinsics[:, 0, 12], by_intrinsics[:, 0, 13] = fx * r2, fx * r4
    by_intrinsics[:, 1, 14], by_intrinsics[:, 1, 15] = fy * r2, fy * r4
    return pixels, by_normal @ normal_by_point, by_intrinsics
