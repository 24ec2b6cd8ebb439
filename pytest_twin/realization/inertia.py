"""Whether a body can have an inertia, and the named repairs of one that it cannot have."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

MASS_FLOOR = 1e-12
"""kg, kg*m^2: what a moving body without mass is given, far below anything that a robot feels."""
ROUNDING = 1e-5
"""Share of the largest moment below which a broken triangle inequality is a matter of digits."""

LAST_DIGITS = 1e-12
"""Share of the largest moment below which it is a matter of how floats add."""


def tensor(values: NDArray[np.float64] | tuple[float, ...]) -> Matrix:
    """(3, 3) from ixx iyy izz [ixy ixz iyz]."""
    xx, yy, zz, xy, xz, yz = (*(float(v) for v in values), 0.0, 0.0, 0.0)[:6]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def six(inertia: Matrix) -> tuple[float, ...]:
    """ixx iyy izz ixy ixz iyz of a (3, 3) tensor."""
    i = inertia
    return tuple(float(v) for v in (i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]))


def of_point(mass: float, offset: NDArray[np.float64]) -> Matrix:
    """Inertia of a point mass at ``offset`` [m]: m (r.r 1 - r r^T)."""
    return np.asarray(mass * (offset @ offset * np.eye(3) - np.outer(offset, offset)))


def violation(inertia: Matrix) -> float:
    """How far the triangle inequality is broken, as a share of the largest moment; 0 if it holds.

    It holds to the last digits: :func:`write` closes those.

    The second moments tr(I)/2 - I_k of a mass that is nowhere negative are not negative
    (Wensing, Kim, Slotine, "Linear matrix inequalities for physically consistent inertial
    parameter identification", 2018).
    """
    moments = np.linalg.eigvalsh(inertia)
    lowest = float(moments.sum() / 2 - moments.max())
    largest = float(np.abs(moments).max())
    share = -lowest / largest if largest > 0 else 0.0
    return share if share > LAST_DIGITS else 0.0


def consistent(inertia: Matrix, floor: float = 0.0) -> Matrix:
    """The inertia with no negative second moment, and moments of at least ``floor``.

    The largest moment of a broken triangle stays and the other two grow until it closes.
    """
    moments, axes = np.linalg.eigh(inertia)
    second = np.maximum(moments.sum() / 2 - moments, 0.0)
    # A hair inside, which the nine digits that twin.yaml states of it do not lose.
    second = np.maximum(second, 1e-7 * second.max() + floor / 2)
    return np.asarray(axes @ np.diag(second.sum() - second) @ axes.T)


def _closed(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Moments (3,) of which the largest is no more than the sum of the others, as floats add.

    MuJoCo compares to the last digit: 0.1 + 0.7 < 0.8 would refuse a flat plate.
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
    """State mass, centre of mass and inertia (body axes, about that centre) on a body's spec."""
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
    body.inertia = _closed(np.maximum(moments, 0.0))
    body.fullinertia = [np.nan, 0, 0, 0, 0, 0]
