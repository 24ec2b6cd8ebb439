"""Rigid transforms with derivatives (forward-mode differentiation).

A change of a transform ``(R, t)`` is written in its parent's axes: ``R' = exp(w) R``,
``t' = t + v``. The rules for products and inverses follow (Sola, Deray, Atchuthan: A micro Lie
theory for state estimation in robotics, 2018, section II).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray

_SMALL_RAD = 1e-6
"""Angle below which a series replaces the formula that divides by the angle."""


@dataclass(frozen=True)
class TransformWithJacobian:
    """Transforms with derivatives by the parameters.

    Attributes:
        rotation: (n, 3, 3) rotation matrices.
        position: (n, 3) positions, m.
        turn: (n, 3, p) derivatives of the rotation, as rotation vectors in the parent's axes, rad
            per unit of a parameter.
        shift: (n, 3, p) derivatives of the position, m per unit of a parameter.
    """

    rotation: FloatArray
    position: FloatArray
    turn: FloatArray
    shift: FloatArray

    def __matmul__(self, other: TransformWithJacobian) -> TransformWithJacobian:
        """Return the product: ``other`` in this transform's parent frame."""
        arm = np.einsum("nij,nj->ni", self.rotation, other.position)
        turn = self.turn + self.rotation @ other.turn
        shift = self.shift + cross_product(self.turn, arm) + self.rotation @ other.shift
        return TransformWithJacobian(
            self.rotation @ other.rotation, self.position + arm, turn, shift
        )

    def inverse(self) -> TransformWithJacobian:
        """Return the inverse transforms."""
        back = np.swapaxes(self.rotation, 1, 2)
        shift = -back @ (self.shift - cross_product(self.turn, self.position))
        position = -np.einsum("nij,nj->ni", back, self.position)
        return TransformWithJacobian(back, position, -back @ self.turn, shift)

    def act(self, point: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points in the parent's frame, (n, 3) m, and their derivatives, (n, 3, p).

        Args:
            point: (n, 3) points in this frame, m.
            slope: (n, 3, p) derivatives of ``point``.
        """
        arm = np.einsum("nij,nj->ni", self.rotation, point)
        moved = self.shift + cross_product(self.turn, arm) + self.rotation @ slope
        return self.position + arm, moved


def cross_product(turn: FloatArray, arm: FloatArray) -> FloatArray:
    """``turn x arm`` for each parameter: (n, 3, p) of (n, 3, p) and (n, 3)."""
    a = arm[:, :, None]
    return np.stack(
        [
            turn[:, 1] * a[:, 2] - turn[:, 2] * a[:, 1],
            turn[:, 2] * a[:, 0] - turn[:, 0] * a[:, 2],
            turn[:, 0] * a[:, 1] - turn[:, 1] * a[:, 0],
        ],
        axis=1,
    )


def skew(vectors: FloatArray) -> FloatArray:
    """(..., 3, 3) matrices of the cross product."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def left_jacobian(vectors: FloatArray) -> FloatArray:
    """(..., 3, 3) ``J`` with ``exp(w + d) = exp(J d) exp(w)`` to first order."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < _SMALL_RAD
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    cross = skew(vectors)
    return np.eye(3) + first * cross + second * (cross @ cross)


def inverse_left_jacobian(vectors: FloatArray) -> FloatArray:
    """(..., 3, 3) inverse of :func:`left_jacobian`."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    exact = 1.0 / safe**2 - (1.0 + np.cos(safe)) / (
        2.0 * safe * np.where(np.abs(np.sin(safe)) < 1e-9, 1e-9, np.sin(safe))
    )
    cross = skew(vectors)
    return np.eye(3) - 0.5 * cross + np.where(small, 1.0 / 12.0, exact) * (cross @ cross)
