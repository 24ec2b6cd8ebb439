"""Coordinates of body inertias in which every value is physically consistent.

The pseudo-inertia of a body (Wensing, Kim, Slotine, IEEE RA-L 3, 2018) is ``R (A + S) R^T``: ``R``
is a root of the nominal pseudo-inertia with a minimum thickness, ``A`` restores the nominal value,
and ``S`` is a symmetric matrix of relative changes, the ten coordinates. The eigenvalues of ``A +
S`` are limited from below, so an unphysical body becomes the nearest physical one. Log-Cholesky
coordinates (Rucker, Wensing, IEEE RA-L 7, 2022) use exponentials instead, which diverge if a fit
has made a body nearly flat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin

from pytest_twin.arrays import FloatArray
from pytest_twin.realization import Realization
from pytest_twin.realization.inertia import compiled_inertia
from pytest_twin.realization.inverse_dynamics import INERTIAL, InverseDynamics, pseudo_inertia
from pytest_twin.realization.rigid_model import moments

AXES = ("s11", "s22", "s33", "s44", "s21", "s31", "s32", "s41", "s42", "s43")
"""Names of the coordinates: the diagonal of ``S``, then the rows below it."""
COUNT = len(AXES)
_THINNEST = 0.05
"""Smallest second moment of the root, relative to the largest. It corresponds to a body with a
thickness of a fifth of its length; thinner bodies vary as if they had this thickness."""
_FLOOR = 0.01
"""Smallest eigenvalue of ``A + S``: 1 % of the nominal mass and inertia."""
_PAYLOAD = 1e-9
"""Fraction of a body's mass above which the model carries an additional payload on it."""
_STEP = 1e-6
"""Smallest value that is assumed for a body's largest second moment, m^2 times its mass."""


@dataclass(frozen=True)
class Body:
    """Body that represents the uncertainty of its link's inertia.

    Attributes:
        name: name of the model's body.
        joint: joint that moves its link.
        root: (4, 4) ``R``, about the body's frame, in body axes.
        middle: (4, 4) ``A``.
        floor: smallest eigenvalue of ``A + S``.
        placement: pose of the body in the frame of the joint's link.
    """

    name: str
    joint: str
    root: FloatArray
    middle: FloatArray
    floor: float
    placement: pin.SE3

    @property
    def scaling(self) -> FloatArray:
        """(10,) coordinates of a body with twice the mass and the same mass distribution."""
        return _coordinates(self.middle)

    def pseudo_inertia(self, x: FloatArray) -> FloatArray:
        """(n, 4, 4) pseudo-inertia at coordinates (n, 10)."""
        side = self._side(x)
        return np.asarray(side @ np.swapaxes(side, 1, 2))

    def rigid(
        self, x: FloatArray, carried: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n,) mass [kg], (n, 3) centre of mass [m], (n, 3, 3) second moments about it [kg*m^2].

        The inertia about the centre is ``trace(C) 1 - C`` with these moments ``C``. They are
        computed from the component of the root's first three rows that is orthogonal to the fourth.
        A difference of large moments would have rounding errors and could be unphysical.

        Args:
            x: (n, 10) coordinates.
            carried: (4, 4) pseudo-inertia of a payload on the body, which does not vary.
        """
        if carried is None:
            side = self._side(x)
        else:
            side = np.asarray(np.linalg.cholesky(self.pseudo_inertia(x) + carried))
        last = side[:, 3]
        mass = np.einsum("ni,ni->n", last, last)
        com = np.einsum("nki,ni->nk", side[:, :3], last) / mass[:, None]
        rest = side[:, :3] - com[:, :, None] * last[:, None, :]
        return mass, com, rest @ np.swapaxes(rest, 1, 2)

    def slope(self) -> FloatArray:
        """(10, 10) derivative of the link's inertial parameters, in the order of ``INERTIAL``."""
        found = np.empty((len(INERTIAL), COUNT))
        for k in range(COUNT):
            change = self.root @ _symmetric(np.eye(COUNT)[k][None])[0] @ self.root.T
            found[:, k] = self._in_link(change)
        return found

    def _in_link(self, change: FloatArray) -> FloatArray:
        """(10,) inertial parameters of a pseudo-inertia change, in the link's frame."""
        homogeneous = self.placement.homogeneous
        moved = homogeneous @ change @ homogeneous.T
        second = moved[:3, :3]
        tensor = np.trace(second) * np.eye(3) - second
        named = {
            "Ixx": tensor[0, 0], "Ixy": tensor[0, 1], "Ixz": tensor[0, 2], "Iyy": tensor[1, 1],
            "Iyz": tensor[1, 2], "Izz": tensor[2, 2], "mx": moved[0, 3], "my": moved[1, 3],
            "mz": moved[2, 3], "m": moved[3, 3],
        }  # fmt: skip
        return np.array([named[name] for name in INERTIAL])

    def _side(self, x: FloatArray) -> FloatArray:
        """(n, 4, 4) roots of the pseudo-inertia at coordinates (n, 10)."""
        values, vectors = np.linalg.eigh(self.middle + _symmetric(x))
        scaled = vectors * np.sqrt(np.maximum(values, self.floor))[:, None, :]
        return np.asarray(self.root @ scaled)


def _symmetric(x: FloatArray) -> FloatArray:
    """(n, 4, 4) ``S`` of (n, 10) coordinates."""
    found = np.zeros((len(x), 4, 4))
    row, column = np.tril_indices(4, -1)
    found[:, row, column] = found[:, column, row] = x[:, 4:]
    found[:, np.arange(4), np.arange(4)] = x[:, :4]
    return found


def _coordinates(matrix: FloatArray) -> FloatArray:
    """(10,) coordinates of a symmetric matrix."""
    return np.concatenate([np.diag(matrix), matrix[np.tril_indices(4, -1)]])


def bodies_of(realization: Realization, joints: Sequence[str]) -> list[Body]:
    """Return the heaviest body of each link that these joints carry."""
    dynamics = InverseDynamics(realization, joints)
    found = []
    for link, joint in zip(dynamics.link_ids, dynamics.links, strict=True):
        members = dynamics.bodies_of(link)
        if not members:
            continue
        heaviest = max(members, key=lambda body: float(body.parameters[0]))
        if heaviest.parameters[0] > 0.0:
            stated = pseudo_inertia_of(realization.model, heaviest.name)
            root = _thick_root(stated)
            middle = np.linalg.solve(root, np.linalg.solve(root, stated).T)
            least = float(np.linalg.eigvalsh(middle).min())
            # A body of a model may be flat or slightly unphysical; it then gets a minimum
            # thickness.
            floor = min(_FLOOR, max(0.5 * least, 1e-6))
            found.append(Body(heaviest.name, joint, root, middle, floor, heaviest.placement))
    return found


def _thick_root(stated: FloatArray) -> FloatArray:
    """(4, 4) root of a body whose second moments are limited to a minimum thickness."""
    mass, com = stated[3, 3], stated[:3, 3] / stated[3, 3]
    values, vectors = np.linalg.eigh(stated[:3, :3] - mass * np.outer(com, com))
    values = np.maximum(values, _THINNEST * max(float(values.max()), _STEP * mass))
    root = np.zeros((4, 4))
    root[:3, :3] = vectors * np.sqrt(values)
    root[:3, 3], root[3, 3] = com * np.sqrt(mass), np.sqrt(mass)
    return root


def principal(second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3) principal moments of inertia, and (n, 3, 3) their axes, right-handed.

    Each moment is the sum of two non-negative second moments, so no moment exceeds the sum of the
    other two.

    Args:
        second: (n, 3, 3) second moments about the centre of mass.
    """
    values, axes = np.linalg.eigh(second)
    values = values.clip(0.0)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return values[:, [1, 0, 0]] + values[:, [2, 2, 1]], axes


def write_bodies(models: Sequence[mujoco.MjModel], body: Body, x: FloatArray) -> None:
    """Write a body's inertia into models; additional payloads on it are kept.

    Args:
        models: one model for each row, with equal inertia of this body before.
        x: (rows, 10) coordinates.
    """
    index = models[0].body(body.name).id
    here = pseudo_inertia_of(models[0], body.name)
    own = body.root @ body.middle @ body.root.T
    much = here[3, 3] - own[3, 3] > _PAYLOAD * here[3, 3]
    mass, com, second = body.rigid(x, here - own if much else None)
    inertia, axes = principal(second)
    for at, model in enumerate(models):
        model.body_mass[index], model.body_ipos[index] = mass[at], com[at]
        model.body_inertia[index] = inertia[at]
        mujoco.mju_mat2Quat(model.body_iquat[index], axes[at].ravel())
        # The inertial frame may no longer coincide with the body's frame.
        model.body_sameframe[index] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)


def pseudo_inertia_of(model: mujoco.MjModel, name: str) -> FloatArray:
    """(4, 4) pseudo-inertia of a model's body, about its own frame."""
    index = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
    return pseudo_inertia(moments(*compiled_inertia(model, index), pin.SE3.Identity()))
