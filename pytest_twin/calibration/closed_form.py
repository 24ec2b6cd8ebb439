"""Algebraic solutions without iterations: hand-eye, point sets, pivots."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray

_MOST_PAIRS = 2000
"""Relative motions used: more add time and no accuracy that a start needs."""


def rigid(rotation: FloatArray, position: FloatArray) -> FloatArray:
    """(4, 4) transform of a rotation (3, 3) and a position (3,)."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, position
    return transform


def inverse(transforms: FloatArray) -> FloatArray:
    """The (..., 4, 4) rigid transforms the other way."""
    back = np.zeros_like(transforms)
    turn = np.swapaxes(transforms[..., :3, :3], -1, -2)
    back[..., :3, :3] = turn
    back[..., :3, 3] = -np.einsum("...ij,...j->...i", turn, transforms[..., :3, 3])
    back[..., 3, 3] = 1.0
    return back


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """The (3, 3) rotation nearest to a matrix."""
    left, _, right = np.linalg.svd(matrix)
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0])
    return np.asarray(left @ turn @ right)


def park(flange: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses ``mounted`` and ``world`` with ``flange @ mounted = world @ seen``.

    The rotation from relative motions (Park and Martin: Robot sensor calibration, 1994), both
    positions by linear least squares over all poses.

    Args:
        flange: (n, 4, 4) ``transform_base_to_flange``, m.
        seen: (n, 4, 4), m.
    """
    a = _relative_turns(flange)
    b = _relative_turns(seen)
    # a_ij = R b_ij for each pair of poses.
    rotation = nearest_rotation(a.T @ b)
    turns = flange[:, :3, :3] @ rotation @ np.swapaxes(seen[:, :3, :3], 1, 2)
    world = nearest_rotation(turns.sum(axis=0))
    return positions(flange, seen, rotation, world)


def _relative_turns(poses: FloatArray) -> FloatArray:
    count = len(poses)
    first, second = np.triu_indices(count, 1)
    if len(first) > _MOST_PAIRS:
        kept = np.linspace(0, len(first) - 1, _MOST_PAIRS).astype(int)
        first, second = first[kept], second[kept]
    turns = np.swapaxes(poses[first, :3, :3], 1, 2) @ poses[second, :3, :3]
    return np.asarray(Rotation.from_matrix(turns).as_rotvec())


def shah(flange: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """As :func:`park`, both rotations at once by a Kronecker product.

    (Shah: Solving the robot-world/hand-eye calibration problem using the Kronecker product, 2013.)
    """
    product = sum(np.kron(b[:3, :3], a[:3, :3]) for a, b in zip(flange, seen, strict=True))
    left, _, right = np.linalg.svd(np.asarray(product))
    mounted = right[0].reshape(3, 3).T
    world = left[:, 0].reshape(3, 3).T
    if np.linalg.det(mounted) < 0:
        mounted, world = -mounted, -world
    return positions(flange, seen, nearest_rotation(mounted), nearest_rotation(world))


def positions(
    flange: FloatArray, seen: FloatArray, mounted: FloatArray, world: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Both poses of :func:`park` with their positions, from both rotations."""
    count = len(flange)
    # R_flange t_mounted + t_flange = R_world t_seen + t_world
    matrix = np.zeros((count, 3, 6))
    matrix[:, :, :3] = flange[:, :3, :3]
    matrix[:, :, 3:] = -np.eye(3)
    right = seen[:, :3, 3] @ world.T - flange[:, :3, 3]
    found = _solved(matrix.reshape(-1, 6), right.reshape(-1))
    return rigid(mounted, found[:3]), rigid(world, found[3:])


def scale_of_seen(flange: FloatArray, seen: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """As :func:`park`, with a factor by which positions in ``seen`` must be multiplied."""
    mounted, world = (pose[:3, :3] for pose in park(flange, seen))
    count = len(flange)
    matrix = np.zeros((count, 3, 7))
    matrix[:, :, :3] = flange[:, :3, :3]
    matrix[:, :, 3:6] = -np.eye(3)
    matrix[:, :, 6] = -(seen[:, :3, 3] @ world.T)
    right = -flange[:, :3, 3]
    # Columns of unit length: the rank must not depend on the unit of the positions.
    size = np.linalg.norm(matrix.reshape(-1, 7), axis=0) + 1e-300
    found = _solved(matrix.reshape(-1, 7) / size, right.reshape(-1)) / size
    return float(found[6]), rigid(mounted, found[:3]), rigid(world, found[3:6])


def kabsch(points: FloatArray, others: FloatArray) -> FloatArray:
    """(4, 4) rigid transform that takes ``points`` (n, 3) nearest to ``others``, m.

    (Umeyama: Least-squares estimation of transformation parameters between two point patterns,
    1991, without scale.)
    """
    center, other = points.mean(axis=0), others.mean(axis=0)
    rotation = nearest_rotation((others - other).T @ (points - center))
    return rigid(rotation, other - rotation @ center)


def pivot(flange: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tip in the flange and fixed point in the base, (3,) m, of a tool that turns about its tip."""
    count = len(flange)
    matrix = np.zeros((count, 3, 6))
    matrix[:, :, :3] = flange[:, :3, :3]
    matrix[:, :, 3:] = -np.eye(3)
    right = -flange[:, :3, 3].reshape(-1)
    found = _solved(matrix.reshape(-1, 6), right)
    return found[:3], found[3:]


def markers(
    flange: list[FloatArray], seen: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray]]:
    """Measuring frame in the base, and each marker in the flange, from markers on the flange.

    Linear in the frame's nine direction cosines, its position and the markers' places; the nine
    are then replaced by the nearest rotation and the rest is solved again.

    Args:
        flange: for each marker, (n, 4, 4) ``transform_base_to_flange``, m.
        seen: for each marker, (n, 3) in the measuring frame, m.
    """
    width = 12 + 3 * len(seen)
    rows, right = [], []
    for at, (poses, points) in enumerate(zip(flange, seen, strict=True)):
        matrix = np.zeros((len(poses), 3, width))
        for axis in range(3):
            matrix[:, axis, 3 * axis : 3 * axis + 3] = points
            matrix[:, axis, 9 + axis] = 1.0
        matrix[:, :, 12 + 3 * at : 15 + 3 * at] = -poses[:, :3, :3]
        rows.append(matrix.reshape(-1, width))
        right.append(poses[:, :3, 3].reshape(-1))
    matrix, values = np.concatenate(rows), np.concatenate(right)
    found = _solved(matrix, values)
    rotation = nearest_rotation(found[:9].reshape(3, 3))
    rest = values - matrix[:, :9] @ rotation.reshape(-1)
    found = _solved(matrix[:, 9:], rest)
    places = [found[3 + 3 * at : 6 + 3 * at] for at in range(len(seen))]
    return rigid(rotation, found[:3]), places


def scale_of_marker(flange: FloatArray, seen: FloatArray) -> tuple[float, float]:
    """Factor by which a marker's positions must be multiplied, and the median error then left, m.

    The linear solution of :func:`markers` leaves the nine numbers of the rotation free, so that
    their size is the factor.
    """
    matrix = np.zeros((len(flange), 3, 15))
    size = float(np.median(np.linalg.norm(seen, axis=1))) or 1.0
    for axis in range(3):
        matrix[:, axis, 3 * axis : 3 * axis + 3] = seen / size
        matrix[:, axis, 9 + axis] = 1.0
    matrix[:, :, 12:] = -flange[:, :3, :3]
    values = flange[:, :3, 3].reshape(-1)
    found = _solved(matrix.reshape(-1, 15), values)
    turn = found[:9].reshape(3, 3)
    factor = float(np.cbrt(max(np.linalg.det(turn), 0.0)))
    errors = (matrix.reshape(-1, 15) @ found - values).reshape(-1, 3)
    return factor / size, float(np.median(np.linalg.norm(errors, axis=1)))


def _solved(matrix: FloatArray, values: FloatArray) -> FloatArray:
    """The smallest least-squares solution."""
    return np.asarray(np.linalg.lstsq(matrix, values, rcond=1e-9)[0], dtype=np.float64)
