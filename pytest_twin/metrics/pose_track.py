"""Distances between two trajectories of a rigid body, at each sample."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray


def position_errors(poses: FloatArray, measured: FloatArray) -> FloatArray:
    """(..., n) Euclidean distances of the positions of two trajectories, in their unit.

    Args:
        poses, measured: (..., n, 7) position and quaternion w x y z.
    """
    return np.asarray(np.linalg.norm(poses[..., :3] - measured[..., :3], axis=-1))


def rotation_errors(poses: FloatArray, measured: FloatArray) -> FloatArray:
    """(..., n) geodesic distances on SO(3) of two trajectories, rad, 0 to pi.

    ``4 atan2(|q - p|, |q + p|)`` for unit quaternions of either sign (Kahan, 2006) is precise near
    0, unlike the arc cosine.

    Args:
        poses, measured: (..., n, 7) position and unit quaternion w x y z.
    """
    one, other = poses[..., 3:], measured[..., 3:]
    apart = np.linalg.norm(one - other, axis=-1)
    along = np.linalg.norm(one + other, axis=-1)
    return np.asarray(4.0 * np.arctan2(np.minimum(apart, along), np.maximum(apart, along)))
