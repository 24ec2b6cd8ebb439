"""Statistics of the difference between a prediction and a measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Residual:
    """Statistics of a series ``predicted - measured``, in its unit.

    Attributes:
        maximum: largest absolute value.
        maximum_at: index of the sample with the largest absolute value.
    """

    rms: float
    maximum: float
    mean: float
    maximum_at: int


def residual(predicted: FloatArray, measured: FloatArray) -> Residual:
    """Compare two (n,) series sample by sample, with equal weights.

    If a sample is not finite, all statistics are NaN, and ``maximum_at`` is its index.
    """
    difference = predicted - measured
    broken = np.flatnonzero(~np.isfinite(difference))
    if broken.size or not difference.size:
        return Residual(np.nan, np.nan, np.nan, int(broken[0]) if broken.size else 0)
    worst = int(np.argmax(np.abs(difference)))
    return Residual(
        rms=float(np.sqrt(np.mean(difference**2))),
        maximum=float(np.abs(difference[worst])),
        mean=float(np.mean(difference)),
        maximum_at=worst,
    )


def rotation_angle(quaternion_a: FloatArray, quaternion_b: FloatArray) -> FloatArray:
    """(n,) angles between orientations, rad, 0 to pi.

    Args:
        quaternion_a, quaternion_b: (n, 4) unit quaternions, w x y z; q and -q are one orientation.
    """
    # |q_a - q_b| and |q_a + q_b| are 2 sin and 2 cos of a quarter of the angle. This is precise for
    # small angles, unlike the arc cosine of the inner product.
    minus = np.linalg.norm(quaternion_a - quaternion_b, axis=-1)
    plus = np.linalg.norm(quaternion_a + quaternion_b, axis=-1)
    angle: FloatArray = 4.0 * np.arctan2(np.minimum(minus, plus), np.maximum(minus, plus))
    return angle
