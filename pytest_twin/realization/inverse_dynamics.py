"""Inverse dynamics of a tree of rigid bodies, linear in its inertial parameters (Pinocchio)."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import pinocchio as pin

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import ModelError, SpecError
from pytest_twin.realization.named_model import NamedModel
from pytest_twin.realization.patch import suggest
from pytest_twin.realization.reference import Reference

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
        found = np.empty((len(position), len(self.joints), len(self._links), 10))
        model, data = self._model, self._data
        q, v, a = self._neutral.copy(), np.zeros(model.nv), np.zeros(model.nv)
        rows = np.array([model.joints[i].idx_v for i in self._ids], dtype=np.intp)
        starts = np.array([10 * (i - 1) for i in self._links], dtype=np.intp)
        columns = (starts[:, None] + _ORDER).ravel()
        own = position - self._offsets
        for at in range(len(position)):
            for joint, value in zip(self._ids, own[at], strict=True):
                one = model.joints[joint]
                if one.nq == 2:
                    q[one.idx_q : one.idx_q + 2] = np.cos(value), np.sin(value)
                else:
                    q[one.idx_q] = value
            v[rows], a[rows] = velocity[at], acceleration[at]
            whole = pin.computeJointTorqueRegressor(model, data, q, v, a)
            # One row comes back without its axis.
            whole = whole.reshape(model.nv, -1)
            found[at] = whole[np.ix_(rows, columns)].reshape(len(rows), -1, 10)
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
