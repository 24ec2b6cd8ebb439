"""Reference model of a robot in Pinocchio, independent of MuJoCo's compiler and engine.

Pinocchio parses a URDF itself. For an MJCF, the model is built joint by joint from the values in
the file, with defaults applied. Orientations, angles, frames and inertias from shapes are computed
here, not by MuJoCo's compiler.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from pytest_twin.errors import SpecError
from pytest_twin.realization import reference_mjcf, reference_urdf
from pytest_twin.realization.named_model import NamedModel
from pytest_twin.realization.patch import suggest
from pytest_twin.realization.rigid_model import RigidModel

Vector = NDArray[np.float64]
Value = float | Vector


class Reference:
    """A robot in Pinocchio.

    Joint values are mappings from joint to rad or m; other joints are at the model's reference.
    A ball joint takes (4,) w x y z, a free joint (7,) x y z (m), w x y z.

    Attributes:
        model: model of Pinocchio, with the twin's fit and the variant's payload.
        joints: joint names in the order of the realization; unnamed joints are ``joint#3``.
        notes: values that were taken from MuJoCo, because they are not computed independently.

    Raises:
        ModelError: the model has an element that a tree of rigid bodies cannot express.
    """

    def __init__(self, realization: NamedModel) -> None:
        robot = realization.source.urdf
        if robot is not None and reference_urdf.is_described(realization, robot):
            rigid = reference_urdf.build(realization, robot)
        else:
            rigid = reference_mjcf.build(realization)
        self._rigid: RigidModel = rigid
        self._path = realization.path
        self.model: pin.Model = rigid.model
        self.joints: tuple[str, ...] = tuple(rigid.joints)
        self.notes: tuple[str, ...] = tuple(rigid.notes)
        self._data = self.model.createData()

    def configuration(self, q: Mapping[str, Value]) -> Vector:
        """(nq,) configuration of Pinocchio; joints that are not given are at the reference."""
        return self._configuration(q)

    @property
    def frames(self) -> Mapping[str, tuple[int, pin.SE3]]:
        """Site or body -> index of the Pinocchio joint that moves it, and its pose in the joint."""
        return self._rigid.frames

    @property
    def world(self) -> pin.SE3:
        """Pose of Pinocchio's universe frame in the world."""
        return self._rigid.world

    def zero_of(self, joint: str) -> float:
        """Joint value of the pose that the file describes, rad or m."""
        return self._rigid.reference.get(joint, 0.0)

    def armature_of(self, joint: str) -> float:
        """Armature of a joint in the model, kg*m^2 or kg."""
        return self._rigid.armature.get(joint, 0.0)

    def free_joint_turn(self, joint: int) -> Vector:
        """(3, 3) orientation in the world of the frame to which a free joint's value refers.

        Args:
            joint: its index in Pinocchio.
        """
        return np.asarray(self._free_joint_origin(self.model.joints[joint]).rotation)

    def frame_pose(self, q: Mapping[str, Value], frame: str) -> Vector:
        """Pose (4, 4) of a site or body in the world, m; a site takes precedence over a body."""
        if frame not in self._rigid.frames:
            raise SpecError(
                f"the model has no frame {frame!r}",
                path=self._path,
                expected=suggest(frame, self._rigid.frames),
            )
        joint, placement = self._rigid.frames[frame]
        pin.forwardKinematics(self.model, self._data, self._configuration(q))
        pose: Vector = (self._rigid.world * self._data.oMi[joint] * placement).homogeneous
        return pose

    def mass(self) -> float:
        """Mass of the whole robot with its fixed bodies, kg."""
        return float(sum(inertia.mass for inertia in self.model.inertias))

    def center_of_mass(self, q: Mapping[str, Value]) -> Vector:
        """(3,) centre of mass of the whole robot in the world, m."""
        pin.forwardKinematics(self.model, self._data, self._configuration(q))
        moment = np.zeros(3)
        for placement, inertia in zip(self._data.oMi, self.model.inertias, strict=True):
            moment += inertia.mass * placement.act(inertia.lever)
        mass = self.mass()
        return np.asarray(self._rigid.world.act(moment / mass if mass > 0 else moment))

    def gravity_torque(self, q: Mapping[str, Value]) -> dict[str, Value]:
        """Generalized force of each joint that balances gravity at rest.

        N*m for a hinge, N for a slide; (3,) N*m in the joint's frame for a ball joint; (6,) force
        in world axes [N] and torque in body axes [N*m] for a free joint.
        """
        configuration = self._configuration(q)
        torque = pin.computeGeneralizedGravity(self.model, self._data, configuration)
        return {name: self._force_in_world(name, torque, configuration) for name in self.joints}

    def mass_matrix(self, q: Mapping[str, Value]) -> Vector:
        """(nv, nv) joint-space inertia matrix with armature, in the order of ``joints``; SI."""
        configuration = self._configuration(q)
        matrix = np.array(pin.crba(self.model, self._data, configuration))
        matrix = np.triu(matrix) + np.triu(matrix, 1).T
        change = np.eye(self.model.nv)
        order: list[int] = []
        for name in self.joints:
            joint = self.model.joints[self._rigid.joints[name]]
            span = slice(joint.idx_v, joint.idx_v + joint.nv)
            change[span, span] = self._body_to_world(name, configuration)
            order.extend(range(span.start, span.stop))
        matrix = (change @ matrix @ change.T)[np.ix_(order, order)]
        armature = [self._rigid.armature.get(name, 0.0) for name in self.joints]
        widths = [self.model.joints[self._rigid.joints[name]].nv for name in self.joints]
        return np.asarray(matrix + np.diag(np.repeat(armature, widths)))

    def _force_in_world(self, name: str, values: Vector, configuration: Vector) -> Value:
        joint = self.model.joints[self._rigid.joints[name]]
        own = (
            self._body_to_world(name, configuration) @ values[joint.idx_v : joint.idx_v + joint.nv]
        )
        return float(own[0]) if joint.nv == 1 else np.asarray(own)

    def _body_to_world(self, name: str, configuration: Vector) -> Vector:
        """Square matrix that rotates the linear part of a free joint from body to world axes."""
        joint = self.model.joints[self._rigid.joints[name]]
        change = np.eye(joint.nv)
        if joint.nv == 6:
            x, y, z, w = configuration[joint.idx_q + 3 : joint.idx_q + 7]
            turn = pin.Quaternion(w, x, y, z).matrix()
            change[:3, :3] = self._free_joint_origin(joint).rotation @ turn
        return change

    def _configuration(self, q: Mapping[str, Value]) -> Vector:
        full: Vector = pin.neutral(self.model)
        for name in (*self._rigid.neutral, *q):
            if name not in self._rigid.joints:
                raise SpecError(
                    f"the model has no joint {name!r}",
                    path=self._path,
                    expected=suggest(name, self.joints),
                )
            value = q[name] if name in q else self._rigid.neutral[name]
            joint = self.model.joints[self._rigid.joints[name]]
            full[joint.idx_q : joint.idx_q + joint.nq] = self._joint_values(
                name, np.atleast_1d(np.asarray(value, dtype=np.float64)), joint
            )
        return full

    def _joint_values(self, name: str, values: Vector, joint: pin.JointModel) -> Vector:
        width = {3: 4, 6: 7}.get(joint.nv, 1)
        if values.shape != (width,) or not np.isfinite(values).all():
            raise SpecError(
                f"not a value of joint {name!r}",
                path=self._path,
                value=values.tolist(),
                expected="one finite number" if width == 1 else f"{width} finite numbers",
            )
        if joint.nv == 1:
            angle = float(values[0]) - self._rigid.reference.get(name, 0.0)
            return np.array([np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle])
        if joint.nv == 3:
            turned: Vector = np.roll(values / np.linalg.norm(values), -1)
            return turned
        turn = values[3:] / np.linalg.norm(values[3:])
        pose = self._free_joint_origin(joint).actInv(pin.SE3(pin.Quaternion(*turn), values[:3]))
        return np.asarray(pin.SE3ToXYZQUAT(pose), dtype=np.float64)

    def _free_joint_origin(self, joint: pin.JointModel) -> pin.SE3:
        """Pose in the world of the frame to which Pinocchio's value of a free joint refers."""
        return self._rigid.world * self.model.jointPlacements[joint.id]
