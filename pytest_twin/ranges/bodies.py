"""Inertias of bodies in coordinates in which every value is a real body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin

from pytest_twin.arrays import FloatArray
from pytest_twin.realization import Realization
from pytest_twin.realization.inverse_dynamics import INERTIAL, InverseDynamics, pseudo_inertia
from pytest_twin.realization.log_cholesky import (
    COUNT,
    pseudo_inertia_at,
    rigid_at,
    root_of_body,
)
from pytest_twin.realization.rigid import moments

_PINOCCHIO = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
_TO_INERTIAL = [_PINOCCHIO.index(name) for name in INERTIAL]
_STEP = 1e-6
_PAYLOAD = 1e-9
"""Share of a body's mass above which a model carries more on it than the twin's own."""


@dataclass(frozen=True)
class Body:
    """One body that carries what is uncertain of its link.

    Attributes:
        name: of the model's body.
        joint: that moves its link.
        root: (4, 4) of its pseudo-inertia about its own frame, body axes.
        placement: in the frame of the joint's link.
    """

    name: str
    joint: str
    root: FloatArray
    placement: pin.SE3

    def rigid(
        self, x: FloatArray, carried: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n,) mass [kg], (n, 3) centre of mass [m], (n, 3, 3) second moments about it [kg*m^2].

        Args:
            x: (n, 10) log-Cholesky coordinates.
            carried: (4, 4) pseudo-inertia of a payload on the body, which stays the same.
        """
        if carried is None:
            return rigid_at(self.root, x)
        whole = pseudo_inertia_at(self.root, x) + carried
        mass = whole[:, 3, 3]
        com = whole[:, :3, 3] / mass[:, None]
        about = mass[:, None, None] * com[:, :, None] * com[:, None, :]
        return mass, com, whole[:, :3, :3] - about

    def slope(self) -> FloatArray:
        """(10, 10) derivative of the link's inertial parameters, in the order of ``INERTIAL``."""
        found = np.empty((len(INERTIAL), COUNT))
        for k in range(COUNT):
            step = np.zeros((2, COUNT))
            step[:, k] = (_STEP, -_STEP)
            mass, com, second = self.rigid(step)
            tensor = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
            up, down = (moments(float(mass[i]), com[i], tensor[i], self.placement) for i in (0, 1))
            found[:, k] = ((up - down) / (2.0 * _STEP))[_TO_INERTIAL]
        return found


def bodies_of(realization: Realization, joints: Sequence[str]) -> list[Body]:
    """The heaviest body of each link that these joints carry, as the model has it."""
    dynamics = InverseDynamics(realization, joints)
    found = []
    for link, joint in zip(dynamics.link_ids, dynamics.links, strict=True):
        members = dynamics.bodies_of(link)
        if not members:
            continue
        heaviest = max(members, key=lambda body: float(body.parameters[0]))
        if heaviest.parameters[0] <= 0.0:
            continue
        found.append(
            Body(
                heaviest.name,
                joint,
                root_of_body(pseudo_inertia_of(realization.model, heaviest.name)),
                heaviest.placement,
            )
        )
    return found


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
        x: (rows, 10) log-Cholesky coordinates.
    """
    index = models[0].body(body.name).id
    here = pseudo_inertia_of(models[0], body.name)
    carried = here - body.root @ body.root.T
    much = here[3, 3] - (body.root @ body.root.T)[3, 3] > _PAYLOAD * here[3, 3]
    mass, com, second = body.rigid(x, carried if much else None)
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
