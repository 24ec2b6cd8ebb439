"""Distances between two motions of a rigid body, sample by sample."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray


def position_errors(poses: FloatArray, measured: FloatArray) -> FloatArray:
    """(..., n) Euclidean distances of two motions, in the unit of both.

    Args:
        poses, measured: (..., n, 7) position and quaternion w x y z.
    """
    return np.asarray(np.linalg.norm(poses[..., :3] - measured[..., :3], axis=-1))


def rotation_errors(poses: FloatArray, measured: FloatArray) -> FloatArray:
    """(..., n) geodesic distances on SO(3) of two motions, rad, 0 to pi.

    ``2 atan2(|q - p|, |q + p|)`` doubled for unit quaternions of either sign (Kahan, 2006): precise
    near 0, where an arc cosine is not.

    Args:
        poses, measured: (..., n, 7) position and unit quaternion w x y z.
    """
    one, other = poses[..., 3:], measured[..., 3:]
    apart = np.linalg.norm(one - other, axis=-1)
    along = np.linalg.norm(one + other, axis=-1)
    return np.asarray(4.0 * np.arctan2(np.minimum(apart, along), np.maximum(apart, along)))
