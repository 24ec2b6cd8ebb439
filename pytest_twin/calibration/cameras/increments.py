"""Jacobians of small changes of rigid transforms.

A change of a transform ``parent_from_child`` is (6,): ``v`` (m), then ``w`` (rad), both in the
parent's axes: ``t' = t + v``, ``R' = exp(w) R``. Matrices here take the change of one transform to
the change of another that is computed from it, to first order.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.transform_derivatives import skew


def apply_change(transforms: FloatArray, steps: FloatArray) -> FloatArray:
    """(..., 4, 4) transforms after changes of (..., 6)."""
    found = transforms.copy()
    turns = Rotation.from_rotvec(steps[..., 3:].reshape(-1, 3)).as_matrix()
    found[..., :3, :3] = turns.reshape(*steps.shape[:-1], 3, 3) @ transforms[..., :3, :3]
    found[..., :3, 3] += steps[..., :3]
    return found


def jacobian_by_first(first: FloatArray, second: FloatArray) -> FloatArray:
    """(..., 6, 6) Jacobian of ``first @ second`` with respect to ``first``."""
    arm = np.einsum("...ij,...j->...i", first[..., :3, :3], second[..., :3, 3])
    found = np.zeros((*arm.shape[:-1], 6, 6))
    found[...] = np.eye(6)
    found[..., :3, 3:] = -skew(arm)
    return found


def jacobian_by_second(first: FloatArray) -> FloatArray:
    """(..., 6, 6) Jacobian of ``first @ second`` with respect to ``second``."""
    return _twice(first[..., :3, :3])


def jacobian_of_inverse(transforms: FloatArray) -> FloatArray:
    """(..., 6, 6) Jacobian of the inverses with respect to the transforms."""
    back = np.swapaxes(transforms[..., :3, :3], -1, -2)
    found = -_twice(back)
    found[..., :3, 3:] = -back @ skew(transforms[..., :3, 3])
    return found


def difference(measured: FloatArray, predicted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``inv(measured) @ predicted`` as (..., 6), and its (..., 6, 6) Jacobian by ``predicted``."""
    back = np.swapaxes(measured[..., :3, :3], -1, -2)
    shift = np.einsum("...ij,...j->...i", back, predicted[..., :3, 3] - measured[..., :3, 3])
    turn = Rotation.from_matrix((back @ predicted[..., :3, :3]).reshape(-1, 3, 3)).as_rotvec()
    turn = turn.reshape(shift.shape)
    slope = _twice(back)
    slope[..., 3:, 3:] = _inverse_left_jacobian(turn) @ back
    return np.concatenate([shift, turn], axis=-1), slope


def by_measured(measured: FloatArray, predicted: FloatArray, slope: FloatArray) -> FloatArray:
    """(..., 6, 6) Jacobian of ``difference`` by ``measured``, from that by ``predicted``."""
    lever = np.zeros_like(slope)
    lever[...] = np.eye(6)
    lever[..., :3, 3:] = -skew(predicted[..., :3, 3] - measured[..., :3, 3])
    return -slope @ lever


def _inverse_left_jacobian(turn: FloatArray) -> FloatArray:
    """(..., 3, 3) ``J`` with ``log(exp(d) exp(turn)) = turn + J d`` to first order."""
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    half = np.maximum(angle, 1e-3) / 2.0
    # Below 1 mrad the factor equals 1/12 to seven digits.
    factor = (1.0 - half / np.tan(half)) / np.maximum(angle, 1e-3) ** 2
    cross = skew(turn)
    return np.asarray(np.eye(3) - 0.5 * cross + factor * (cross @ cross), dtype=np.float64)


def _twice(rotation: FloatArray) -> FloatArray:
    found = np.zeros((*rotation.shape[:-2], 6, 6))
    found[..., :3, :3] = rotation
    found[..., 3:, 3:] = rotation
    return found
