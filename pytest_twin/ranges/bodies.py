"""Inertias of bodies in coordinates in which every value is a real body.

The pseudo-inertia of a body (Wensing, Kim, Slotine, IEEE RA-L 3, 2018) is ``R (A + S) R^T``: ``R``
a root of the model's body with some thickness, ``A`` what makes it the model's, and ``S`` the ten
coordinates, a symmetric matrix of relative changes. Whatever ``S``, no eigenvalue of ``A + S`` is
less than a floor: a body that cannot be becomes the nearest one that can. Log-Cholesky coordinates
(Rucker, Wensing, IEEE RA-L 7, 2022) do the same by exponentials, which run away where a fit has
made a body nearly flat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin

from pytest_twin.arrays import FloatArray
from pytest_twin.realization import Realization
from pytest_twin.realization.inverse_dynamics import INERTIAL, InverseDynamics, pseudo_inertia
from pytest_twin.realization.rigid import moments

AXES = ("s11", "s22", "s33", "s44", "s21", "s31", "s32", "s41", "s42", "s43")
"""Names of the coordinates: the diagonal of ``S``, then what is below it, row by row."""
COUNT = len(AXES)
_THINNEST = 0.05
"""Share of the largest second moment that the least of the root has: a body as thin as a fifth of
its length; thinner ones vary as if they were so thick."""
_FLOOR = 0.01
"""Least eigenvalue of ``A + S``: a hundredth of the model's mass and inertia."""
_PAYLOAD = 1e-9
"""Share of a body's mass above which a model carries more on it than the twin's own."""
_STEP = 1e-6


@dataclass(frozen=True)
class Body:
    """One body that carries what is uncertain of its link.

    Attributes:
        name: of the model's body.
        joint: that moves its link.
        root: (4, 4) ``R``, about the body's own frame, body axes.
        middle: (4, 4) ``A``.
        floor: least eigenvalue of ``A + S``.
        placement: in the frame of the joint's link.
    """

    name: str
    joint: str
    root: FloatArray
    middle: FloatArray
    floor: float
    placement: pin.SE3

    @property
    def scaling(self) -> FloatArray:
        """(10,) coordinates of a body of twice the mass in the same places."""
        return _coordinates(self.middle)

    def pseudo_inertia(self, x: FloatArray) -> FloatArray:
        """(n, 4, 4) at coordinates (n, 10)."""
        side = self._side(x)
        return np.asarray(side @ np.swapaxes(side, 1, 2))

    def rigid(
        self, x: FloatArray, carried: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n,) mass [kg], (n, 3) centre of mass [m], (n, 3, 3) second moments about it [kg*m^2].

        The inertia about the centre is ``trace(C) 1 - C`` of these moments ``C``. They come from
        what of the first three rows of a root is orthogonal to the fourth: a difference of large
        moments would leave rounding, and may be no body's.

        Args:
            x: (n, 10) coordinates.
            carried: (4, 4) pseudo-inertia of a payload on the body, which stays the same.
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
        """(10,) a change of the pseudo-inertia in the frame of the joint's link; it is linear."""
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
    """The heaviest body of each link that these joints carry, as the model has it."""
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
            # A model's body may be flat, or impossible by a digit: it has some thickness then.
            floor = min(_FLOOR, max(0.5 * least, 1e-6))
            found.append(Body(heaviest.name, joint, root, middle, floor, heaviest.placement))
    return found


def _thick_root(stated: FloatArray) -> FloatArray:
    """(4, 4) root of the body with second moments about its centre that are not thin."""
    mass, com = stated[3, 3], stated[:3, 3] / stated[3, 3]
    values, vectors = np.linalg.eigh(stated[:3, :3] - mass * np.outer(com, com))
    values = np.maximum(values, _THINNEST * max(float(values.max()), _STEP * mass))
    root = np.zeros((4, 4))
    root[:3, :3] = vectors * np.sqrt(values)
    root[:3, 3], root[3, 3] = com * np.sqrt(mass), np.sqrt(mass)
    return root


def principal(second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3) principal moments of inertia, and (n, 3, 3) their axes, right-handed.

    The moments are sums of two second moments that are not negative: no moment is larger than the
    sum of the other two.

    Args:
        second: (n, 3, 3) second moments about the centre of mass.
    """
    values, axes = np.linalg.eigh(second)
    values = values.clip(0.0)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return values[:, [1, 0, 0]] + values[:, [2, 2, 1]], axes


def write_bodies(models: Sequence[mujoco.MjModel], body: Body, x: FloatArray) -> None:
    """Write a body's inertia into models; what they carry on it beside the twin's own stays.

    Args:
        models: one for each row, all alike so far.
        body: which.
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
        # A frame that coincided with the body's need not any more.
        model.body_sameframe[index] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)


def pseudo_inertia_of(model: mujoco.MjModel, name: str) -> FloatArray:
    """(4, 4) of a model's body, about its own frame."""
    index = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[index])
    turned = axes.reshape(3, 3)
    tensor = turned @ np.diag(model.body_inertia[index]) @ turned.T
    mass = float(model.body_mass[index])
    return pseudo_inertia(moments(mass, model.body_ipos[index], tensor, pin.SE3.Identity()))
