"""Closed-form solutions for hand-eye, point-set and pivot calibration."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.metrics.pose import rigid

_MOST_PAIRS = 2000
"""Largest number of relative motions. More cost time, and a start needs no more accuracy."""


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """(3, 3) rotation matrix nearest to a matrix (in the Frobenius norm)."""
    left, _, right = np.linalg.svd(matrix)
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0])
    return np.asarray(left @ turn @ right)


def park(flange: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solve ``flange @ mounted = world @ seen`` for ``mounted`` and ``world``.

    The rotation follows from relative motions (Park and Martin: Robot sensor calibration, 1994),
    both positions from linear least squares over all poses.

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
    """Solve the equation of :func:`park`, with both rotations at once by a Kronecker product.

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
    """Return both poses of :func:`park`, with positions that follow from given rotations."""
    count = len(flange)
    # R_flange t_mounted + t_flange = R_world t_seen + t_world
    matrix = np.zeros((count, 3, 6))
    matrix[:, :, :3] = flange[:, :3, :3]
    matrix[:, :, 3:] = -np.eye(3)
    right = seen[:, :3, 3] @ world.T - flange[:, :3, 3]
    solution = least_squares(matrix.reshape(-1, 6), right.reshape(-1))
    return rigid(mounted, solution[:3]), rigid(world, solution[3:])


def scale_of_seen(flange: FloatArray, seen: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Solve the equation of :func:`park` with a scale factor of the positions in ``seen``."""
    mounted, world = (pose[:3, :3] for pose in park(flange, seen))
    count = len(flange)
    matrix = np.zeros((count, 3, 7))
    matrix[:, :, :3] = flange[:, :3, :3]
    matrix[:, :, 3:6] = -np.eye(3)
    matrix[:, :, 6] = -(seen[:, :3, 3] @ world.T)
    right = -flange[:, :3, 3]
    # The columns get unit length, so that the rank does not depend on the unit of the positions.
    size = np.linalg.norm(matrix.reshape(-1, 7), axis=0) + 1e-300
    solution = least_squares(matrix.reshape(-1, 7) / size, right.reshape(-1)) / size
    return float(solution[6]), rigid(mounted, solution[:3]), rigid(world, solution[3:6])


def kabsch(points: FloatArray, others: FloatArray) -> FloatArray:
    """(4, 4) rigid transform that best maps ``points`` (n, 3) to ``others`` (n, 3), m.

    (Umeyama: Least-squares estimation of transformation parameters between two point patterns,
    1991, without scale.)
    """
    center, other = points.mean(axis=0), others.mean(axis=0)
    rotation = nearest_rotation((others - other).T @ (points - center))
    return rigid(rotation, other - rotation @ center)


def pivot(flange: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(3,) tip in the flange and (3,) fixed point in the base, m, of a tool pivoting on its tip."""
    count = len(flange)
    matrix = np.zeros((count, 3, 6))
    matrix[:, :, :3] = flange[:, :3, :3]
    matrix[:, :, 3:] = -np.eye(3)
    right = -flange[:, :3, 3].reshape(-1)
    solution = least_squares(matrix.reshape(-1, 6), right)
    return solution[:3], solution[3:]


def markers(
    flange: list[FloatArray], seen: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray]]:
    """Tracker frame in the base, and position of each marker in the flange, m.

    The problem is linear in the frame's nine direction cosines, its position and the markers'
    positions. The nine cosines are then replaced by the nearest rotation, and the rest is solved
    again.

    Args:
        flange: for each marker, (n, 4, 4) ``transform_base_to_flange``, m.
        seen: for each marker, (n, 3) positions in the tracker's frame, m.
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
    solution = least_squares(matrix, values)
    rotation = nearest_rotation(solution[:9].reshape(3, 3))
    rest = values - matrix[:, :9] @ rotation.reshape(-1)
    solution = least_squares(matrix[:, 9:], rest)
    places = [solution[3 + 3 * at : 6 + 3 * at] for at in range(len(seen))]
    return rigid(rotation, solution[:3]), places


def scale_of_marker(flange: FloatArray, seen: FloatArray) -> tuple[float, float]:
    """Scale factor of a marker's positions, and the median residual with it, m.

    The linear solution of :func:`markers` does not constrain the nine direction cosines to a
    rotation, so their norm gives the factor.
    """
    matrix = np.zeros((len(flange), 3, 15))
    size = float(np.median(np.linalg.norm(seen, axis=1))) or 1.0
    for axis in range(3):
        matrix[:, axis, 3 * axis : 3 * axis + 3] = seen / size
        matrix[:, axis, 9 + axis] = 1.0
    matrix[:, :, 12:] = -flange[:, :3, :3]
    values = flange[:, :3, 3].reshape(-1)
    solution = least_squares(matrix.reshape(-1, 15), values)
    turn = solution[:9].reshape(3, 3)
    factor = float(np.cbrt(max(np.linalg.det(turn), 0.0)))
    errors = (matrix.reshape(-1, 15) @ solution - values).reshape(-1, 3)
    return factor / size, float(np.median(np.linalg.norm(errors, axis=1)))


def least_squares(matrix: FloatArray, values: FloatArray) -> FloatArray:
    """Least-squares solution of minimum norm."""
    return np.asarray(np.linalg.lstsq(matrix, values, rcond=1e-9)[0], dtype=np.float64)
