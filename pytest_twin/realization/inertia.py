"""Physical consistency of inertia tensors, and the repair of inconsistent ones."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

MASS_FLOOR = 1e-12
"""kg and kg*m^2. Mass and moments of a moving body without mass; too small to change the motion."""
LEAST_MASS = 1e-6
"""kg. Every body that states a mass has more; the sum of many ``MASS_FLOOR`` is less."""
ROUNDING = 1e-5
"""Fraction of the largest moment. A smaller violation of the triangle inequality comes from
rounded decimal numbers in the file."""

LAST_DIGITS = 1e-12
"""Fraction of the largest moment. A smaller violation comes from floating-point rounding."""


def tensor(values: NDArray[np.float64] | tuple[float, ...]) -> Matrix:
    """(3, 3) inertia tensor from ixx iyy izz [ixy ixz iyz]."""
    xx, yy, zz, xy, xz, yz = (*(float(v) for v in values), 0.0, 0.0, 0.0)[:6]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def six_components(inertia: Matrix) -> tuple[float, ...]:
    """ixx iyy izz ixy ixz iyz of a (3, 3) tensor."""
    i = inertia
    return tuple(float(v) for v in (i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]))


def compiled_inertia(model: mujoco.MjModel, body: int) -> tuple[float, NDArray[np.float64], Matrix]:
    """Mass [kg], centre of mass (3,) [m] and inertia (3, 3) [kg*m^2] of a body in a model.

    The inertia is about the centre of mass, in the axes of the body.

    Args:
        model: a compiled model.
    """
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    rotation = axes.reshape(3, 3)
    moments = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
    return float(model.body_mass[body]), model.body_ipos[body].copy(), moments


def point_inertia(mass: float, offset: NDArray[np.float64]) -> Matrix:
    """(3, 3) inertia of a point mass [kg] at ``offset`` (3,) [m]: m (r.r 1 - r r^T), kg*m^2."""
    return np.asarray(mass * (offset @ offset * np.eye(3) - np.outer(offset, offset)))


def violation(inertia: Matrix) -> float:
    """Violation of the triangle inequality as a fraction of the largest moment; 0 where it holds.

    Violations below ``LAST_DIGITS`` count as 0; :func:`write` corrects them.

    The second moments tr(I)/2 - I_k of a mass distribution that is nowhere negative are not
    negative (Wensing, Kim, Slotine, "Linear matrix inequalities for physically consistent inertial
    parameter identification", 2018).
    """
    moments = np.linalg.eigvalsh(inertia)
    lowest = float(moments.sum() / 2 - moments.max())
    largest = float(np.abs(moments).max())
    share = -lowest / largest if largest > 0 else 0.0
    return share if share > LAST_DIGITS else 0.0


def nearest_consistent(inertia: Matrix, floor: float = 0.0) -> Matrix:
    """Nearest consistent inertia (3, 3): no negative second moment, moments of at least ``floor``.

    The largest moment stays, and the other two grow until the triangle inequality holds.
    """
    moments, axes = np.linalg.eigh(inertia)
    second = np.maximum(moments.sum() / 2 - moments, 0.0)
    # A margin of 1e-7, so that the nine digits written to twin.yaml remain consistent.
    second = np.maximum(second, 1e-7 * second.max() + floor / 2)
    return np.asarray(axes @ np.diag(second.sum() - second) @ axes.T)


def _with_triangle_inequality(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Moments (3,) whose triangle inequality also holds in floating-point arithmetic.

    MuJoCo compares without a tolerance: for a flat plate, 0.1 + 0.7 < 0.8 would be refused.
    """
    small, middle, large = np.argsort(moments)
    gap = moments[large] - (moments[small] + moments[middle])
    if 0.0 < gap <= LAST_DIGITS * moments[large]:
        moments = moments.copy()
        moments[middle] += gap
        while moments[small] + moments[middle] < moments[large]:
            moments[middle] = np.nextafter(moments[middle], np.inf)
    return moments


def write(body: mujoco.MjsBody, mass: float, com: NDArray[np.float64], inertia: Matrix) -> None:
    """Set mass, centre of mass and inertia of a body's spec.

    Args:
        mass: kg.
        com: (3,) centre of mass in the body's frame, m.
        inertia: (3, 3) about the centre of mass, body axes, kg*m^2.
    """
    moments, axes = np.diag(inertia), np.eye(3)
    if np.any(inertia - np.diag(moments)):
        moments, axes = np.linalg.eigh(inertia)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    body.explicitinertial = True
    body.mass = mass
    body.ipos = com
    body.iquat = quaternion
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.inertia = _with_triangle_inequality(np.maximum(moments, 0.0))
    body.fullinertia = [np.nan, 0, 0, 0, 0, 0]
