"""Inverse dynamics of a tree of rigid bodies, linear in its inertial parameters (Pinocchio)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import ModelError, SpecError
from pytest_twin.realization import inertia
from pytest_twin.realization.named_model import NamedModel
from pytest_twin.realization.patch import suggest
from pytest_twin.realization.reference import Reference
from pytest_twin.realization.rigid import moments

_PINOCCHIO_ORDER = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
INERTIAL = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
"""Inertial parameters of a link: second moments about the joint's origin [kg*m^2], first moments
[kg*m], mass [kg], all in the joint's frame. Second moments go first, so that a base parameter is
called by them where masses are regrouped into it."""
_ORDER = np.array([_PINOCCHIO_ORDER.index(name) for name in INERTIAL])


class InverseDynamics:
    """Effort of rigid bodies for a given motion, as a matrix times inertial parameters.

    Joints that are not named stand at the model's reference. A link has the bodies that are fixed
    to it in it.

    Attributes:
        joints: (joints,) names, each of one degree of freedom; the order of all columns.
        links: joints whose links the named joints carry, each of which has 10 parameters.
        slides: whether each joint is a slide (m, N) and not a hinge (rad, N*m).
        armature: (joints,) kg*m^2 or kg, as the model states it.

    Raises:
        SpecError: a joint that the model lacks.
        ModelError: a joint of more than one degree of freedom, or what Pinocchio cannot express.
    """

    def __init__(self, realization: NamedModel, joints: Sequence[str]) -> None:
        reference = Reference(realization)
        self._model: pin.Model = reference.model
        self._data = self._model.createData()
        self._neutral = reference.configuration({})
        self.joints = tuple(joints)
        self._ids = [_one_joint(realization, reference, name) for name in self.joints]
        self._offsets = np.array([reference.zero_of(name) for name in self.joints])
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        self.slides = tuple(
            bool(realization.model.jnt_type[realization.joint_index(name)] == slide)
            for name in self.joints
        )
        self.armature = np.array([reference.armature_of(name) for name in self.joints])
        moved = {below for joint in self._ids for below in self._model.subtrees[joint].tolist()}
        self._links = sorted(moved)
        self.links = tuple(self._model.names[index] for index in self._links)
        self._bodies = _bodies_of(realization, reference)

    @property
    def link_ids(self) -> tuple[int, ...]:
        """Pinocchio's joints of the links."""
        return tuple(self._links)

    def bodies_of(self, joint: int) -> list[LinkBody]:
        """Bodies of the model on the link of one of Pinocchio's joints."""
        return self._bodies.get(joint, [])

    @property
    def parameters(self) -> FloatArray:
        """(links, 10) inertial parameters that the model states, in the order of ``INERTIAL``."""
        stated = [self._model.inertias[i].toDynamicParameters() for i in self._links]
        return np.array(stated)[:, _ORDER]

    def regressor(
        self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
    ) -> FloatArray:
        """(n, joints, links, 10) derivative of each joint's effort by each inertial parameter.

        Args:
            position: (n, joints) rad or m, as the model counts them.
            velocity, acceleration: (n, joints) rad/s, rad/s^2, or m/s, m/s^2.
        """
        model, data = self._model, self._data
        rows = np.array([model.joints[i].idx_v for i in self._ids], dtype=np.intp)
        starts = np.array([10 * (i - 1) for i in self._links], dtype=np.intp)
        columns = (starts[:, None] + _ORDER).ravel()
        # One look-up for each instant: it costs more than the regressor itself otherwise.
        places = (rows[:, None] * (10 * (model.njoints - 1)) + columns).ravel()
        q = self._configurations(position)
        v, a = np.zeros((2, len(position), model.nv))
        v[:, rows], a[:, rows] = velocity, acceleration
        found = np.empty((len(position), len(places)))
        for at in range(len(position)):
            whole = pin.computeJointTorqueRegressor(model, data, q[at], v[at], a[at])
            found[at] = whole.ravel()[places]
        return found.reshape(len(position), len(rows), len(self._links), 10)

    def _configurations(self, position: FloatArray) -> FloatArray:
        """(n, nq) Pinocchio's configurations; unbounded hinges are cosine and sine."""
        found = np.tile(self._neutral, (len(position), 1))
        for value, joint in zip((position - self._offsets).T, self._ids, strict=True):
            one = self._model.joints[joint]
            if one.nq == 2:
                found[:, one.idx_q], found[:, one.idx_q + 1] = np.cos(value), np.sin(value)
            else:
                found[:, one.idx_q] = value
        return found


def body_patches(
    dynamics: InverseDynamics, parameters: FloatArray
) -> dict[str, dict[str, float | tuple[float, ...]]]:
    """Body -> ``mass`` [kg], ``com`` [m], ``inertia`` (6,) [kg*m^2], as a twin's fit states them.

    The bodies that are fixed to a link keep what the model states; the largest one takes up the
    rest, or all of it where the rest alone could be no body.

    Args:
        dynamics: of the model.
        parameters: (links, 10) of whole links, in the order of ``INERTIAL``; each one a body's.
    """
    found: dict[str, dict[str, float | tuple[float, ...]]] = {}
    for at, stated, new in zip(dynamics.link_ids, dynamics.parameters, parameters, strict=True):
        bodies = dynamics.bodies_of(at)
        if not bodies:
            continue
        change = np.zeros(10)
        change[_ORDER] = new - stated
        main, *others = sorted(bodies, key=lambda body: -body.parameters[0])
        own = main.parameters + change
        if not _is_body(own):
            own = own + sum((body.parameters for body in others), np.zeros(10))
            for body in others:
                found[body.name] = _patch(np.zeros(10), body.placement)
        found[main.name] = _patch(own, main.placement)
    return found


def _is_body(parameters: FloatArray) -> bool:
    return bool(parameters[0] > 0 and np.linalg.eigvalsh(pseudo_inertia(parameters)).min() > 0)


def pseudo_inertia(parameters: FloatArray) -> FloatArray:
    """(4, 4) of (10,) in Pinocchio's order; positive definite for every real body.

    Wensing, Kim, Slotine, IEEE RA-L 3 (2018), eq. 9.
    """
    m, x, y, z, xx, xy, yy, xz, yz, zz = parameters
    half = 0.5 * (xx + yy + zz)
    return np.array(
        [
            [half - xx, -xy, -xz, x],
            [-xy, half - yy, -yz, y],
            [-xz, -yz, half - zz, z],
            [x, y, z, m],
        ]
    )


def _patch(parameters: FloatArray, placement: pin.SE3) -> dict[str, float | tuple[float, ...]]:
    if parameters[0] <= 0:
        return {"mass": 0.0, "com": (0.0, 0.0, 0.0), "inertia": (0.0,) * 6}
    own = placement.actInv(pin.Inertia.FromDynamicParameters(parameters))
    return {
        "mass": float(own.mass),
        "com": tuple(float(v) for v in own.lever),
        "inertia": inertia.six(np.asarray(own.inertia)),
    }


@dataclass(frozen=True)
class LinkBody:
    """A body of the model on the link that a joint moves.

    Attributes:
        placement: of the body in the joint's frame.
        parameters: (10,) in the joint's frame, in Pinocchio's order.
    """

    name: str
    placement: pin.SE3
    parameters: FloatArray


def _bodies_of(realization: NamedModel, reference: Reference) -> dict[int, list[LinkBody]]:
    model = realization.model
    found: dict[int, list[LinkBody]] = {}
    for name, (joint, placement) in reference.frames.items():
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if index <= 0 or joint == 0:
            continue
        axes = pin.Quaternion(*model.body_iquat[index]).matrix()
        tensor = axes @ np.diag(model.body_inertia[index]) @ axes.T
        own = moments(float(model.body_mass[index]), model.body_ipos[index], tensor, placement)
        found.setdefault(joint, []).append(LinkBody(name, placement, own))
    return found


def _one_joint(realization: NamedModel, reference: Reference, name: str) -> int:
    if name not in reference.joints:
        raise SpecError(
            f"the model has no joint {name!r}",
            path=realization.path,
            expected=suggest(name, reference.joints),
        )
    index = reference.model.getJointId(name)
    if reference.model.joints[index].nv != 1:
        raise ModelError(
            f"joint {name!r} has more than one degree of freedom",
            path=realization.path,
            value=int(reference.model.joints[index].nv),
            expected="hinges and slides",
        )
    return int(index)
