"""Distances between rigid-body poses: positions in m, orientations on SO(3) in rad."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pytest_twin.arrays import FloatArray


def rotation_angle(rotation: ArrayLike) -> float:
    """Angle of a rotation matrix, rad, 0 to pi.

    It is the ``atan2`` of sine and cosine (Siciliano et al., Robotics, 2009, eq. 2.28), which,
    unlike the ``arccos`` of the trace, is precise near 0 and pi.

    Args:
        rotation: (3, 3).

    Returns:
        The angle, or NaN where ``rotation`` is not finite.
    """
    matrix = np.asarray(rotation, dtype=np.float64)
    sine = 0.5 * float(np.linalg.norm(_vee(matrix)))
    cosine = 0.5 * (float(np.trace(matrix)) - 1.0)
    return float(np.arctan2(sine, cosine))


def rotation_vector(rotation: ArrayLike) -> FloatArray:
    """(3,) rotation vector (axis times angle) of a rotation matrix, rad; NaN where not finite."""
    matrix = np.asarray(rotation, dtype=np.float64)
    if not np.isfinite(matrix).all():
        return np.full(3, np.nan)
    angle = rotation_angle(matrix)
    quaternion = quaternion_of(matrix)
    axis = quaternion[1:]
    length = float(np.linalg.norm(axis))
    # Below 1e-9 the ratio angle / sin(angle / 2) equals 2 within machine precision.
    scale = 2.0 if length < 1e-9 else angle / length
    return np.asarray(axis * scale, dtype=np.float64)


def orientation_error(rotation: ArrayLike, other: ArrayLike) -> float:
    """Geodesic distance on SO(3) between two (3, 3) orientations of one frame, in rad."""
    return rotation_angle(np.asarray(other, dtype=np.float64).T @ np.asarray(rotation))


def position_error(position: ArrayLike, other: ArrayLike) -> float:
    """Euclidean distance between two (3,) positions, in m."""
    return float(np.linalg.norm(np.asarray(position, dtype=np.float64) - np.asarray(other)))


def direction_error(direction: ArrayLike, other: ArrayLike) -> float:
    """Angle between two (3,) vectors, rad, 0 to pi; NaN where one has zero length.

    ``2 atan2(|u - v|, |u + v|)`` of the unit vectors (Kahan, 2006) is precise for all angles.
    """
    first = np.asarray(direction, dtype=np.float64)
    second = np.asarray(other, dtype=np.float64)
    lengths = np.linalg.norm(first), np.linalg.norm(second)
    if not all(np.isfinite(length) and length > 0.0 for length in lengths):
        return float("nan")
    first, second = first / lengths[0], second / lengths[1]
    return float(2.0 * np.arctan2(np.linalg.norm(first - second), np.linalg.norm(first + second)))


def quaternion_of(rotation: ArrayLike) -> FloatArray:
    """Unit quaternion (w, x, y, z), w not negative, of a (3, 3) rotation matrix.

    The largest of the four components is computed first (Shepperd, 1978), which avoids a division
    by a small number.
    """
    r = np.asarray(rotation, dtype=np.float64)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    squares = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    if not np.isfinite(r).all():
        return np.full(4, np.nan)
    largest = int(np.argmax(squares))
    if largest == 0:
        quaternion = np.array([1.0 + trace, *_vee(r)])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        quaternion = np.empty(4)
        quaternion[0] = r[k, j] - r[j, k]
        quaternion[1 + i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        quaternion[1 + j] = r[j, i] + r[i, j]
        quaternion[1 + k] = r[k, i] + r[i, k]
    quaternion = quaternion / np.linalg.norm(quaternion)
    return np.asarray(-quaternion if quaternion[0] < 0.0 else quaternion, dtype=np.float64)


def rotation_of(quaternion: ArrayLike) -> FloatArray:
    """(3, 3) rotation matrix of a quaternion (w, x, y, z) of any non-zero length."""
    q = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose_vector(transform: ArrayLike) -> FloatArray:
    """(7,) position in m and quaternion (w, x, y, z) of a (4, 4) homogeneous transform."""
    matrix = np.asarray(transform, dtype=np.float64)
    return np.concatenate([matrix[:3, 3], quaternion_of(matrix[:3, :3])])


def rigid(rotation: ArrayLike, position: ArrayLike) -> FloatArray:
    """(..., 4, 4) transforms of rotations (..., 3, 3) and positions (..., 3), m."""
    turn, shift = np.asarray(rotation), np.asarray(position)
    transform = np.zeros((*np.broadcast_shapes(turn.shape[:-2], shift.shape[:-1]), 4, 4))
    transform[..., :3, :3], transform[..., :3, 3], transform[..., 3, 3] = turn, shift, 1.0
    return transform


def inverse(transforms: FloatArray) -> FloatArray:
    """(..., 4, 4) inverses of rigid transforms."""
    turn = np.swapaxes(transforms[..., :3, :3], -1, -2)
    return rigid(turn, -np.einsum("...ij,...j->...i", turn, transforms[..., :3, 3]))


def _vee(matrix: FloatArray) -> FloatArray:
    """(3,) twice the vector of the skew-symmetric part of a (3, 3) matrix."""
    return np.array(
        [
            matrix[2, 1] - matrix[1, 2],
            matrix[0, 2] - matrix[2, 0],
            matrix[1, 0] - matrix[0, 1],
        ]
    )
