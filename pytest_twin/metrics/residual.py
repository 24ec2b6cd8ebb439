"""How far a prediction is from a measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Residual:
    """One series of ``predicted - measured``, in the unit of both.

    Attributes:
        rms: root of the mean square over the samples.
        maximum: largest absolute value; ``maximum_at`` is its sample.
        mean: signed mean.
    """

    rms: float
    maximum: float
    mean: float
    maximum_at: int


def residual(predicted: FloatArray, measured: FloatArray) -> Residual:
    """Compare two (n,) series sample by sample; samples count alike.

    A sample that is not finite in either makes every number NaN, and is the worst sample.
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
    """Angle (rad, 0 to pi) between orientations.

    Args:
        quaternion_a, quaternion_b: (n, 4) unit quaternions, w x y z; q and -q are one orientation.
    """
    # |q_a -+ q_b| = 2 sin, cos of a quarter of the angle: exact for small angles, where the
    # arc cosine of the inner product is not.
    minus = np.linalg.norm(quaternion_a - quaternion_b, axis=-1)
    plus = np.linalg.norm(quaternion_a + quaternion_b, axis=-1)
    angle: FloatArray = 4.0 * np.arctan2(np.minimum(minus, plus), np.maximum(minus, plus))
    return angle
