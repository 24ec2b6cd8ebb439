"""Inverse dynamics of a realization with its drives, linear in all parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import Effect, mjcf_fields
from pytest_twin.effects.rigid_body import Armature
from pytest_twin.effects.sensing import EffortScale
from pytest_twin.errors import SpecError
from pytest_twin.identification.regressor.columns import (
    Column,
    SharedMotor,
    columns,
    drive_effects,
)
from pytest_twin.realization.driven_base import BaseStates
from pytest_twin.realization.inverse_dynamics import INERTIAL, InverseDynamics
from pytest_twin.realization.named_model import NamedModel


class Regressor:
    """Regressor with ``effort = matrix(motion) @ parameters``, on the joint side of the gears.

    effort = rigid bodies + Ia a + fv v + fs sign(v) + off, and the columns of further effects with
    a symbol (Khalil, Dombre, Modeling,
    Identification and Control of Robots, 2002, ch. 12). A motor that two joints share adds
    Iam a_other, fvm v_other to each of both and fsm sign(v_own + v_other) to both (Gautier, ICRA
    1988, for the coupled wrist of the TX series).

    Attributes:
        joints: (joints,) names, in the order of the columns of motion and effort.
        slides: whether each joint is prismatic (m, N) and not revolute (rad, N*m).
        columns: (p,) name, symbol and unit of each parameter.
        prior: (p,) nominal parameters, in the columns' units.

    Args:
        realization: model of the robot, with its payload.
        joints: joints with given motion and effort; others stay at the model's reference.
        shared: motors that two joints share.
        unscaled: joints whose effort is a current with unknown torque constant. Their rows have the
            nominal rigid-body effort as one column, ``effort_scale`` [A/(N*m)], and drive
            parameters in A; they do not determine inertia.
        has_moving_base: whether the floating base that carries the joints moves in the recordings.

    Raises:
        SpecError: the model lacks a joint.
        ModelError: a joint has more than one degree of freedom, or Pinocchio cannot represent the
            model.
    """

    def __init__(
        self,
        realization: NamedModel,
        joints: Sequence[str],
        shared: Sequence[SharedMotor] = (),
        unscaled: Sequence[str] = (),
        *,
        has_moving_base: bool = False,
    ) -> None:
        self.has_moving_base = has_moving_base
        self._dynamics = InverseDynamics(realization, joints)
        self.joints = self._dynamics.joints
        self.slides = self._dynamics.slides
        for motor in shared:
            for joint in (motor.joint, motor.other):
                if joint not in self.joints:
                    raise SpecError(
                        f"a shared motor turns joint {joint!r}, which is not among the identified "
                        "joints",
                        path=realization.path,
                        expected="one of " + ", ".join(self.joints),
                    )
        self._shared = tuple(shared)
        self.columns: tuple[Column, ...] = columns(
            self.joints, self._dynamics.links, self.slides, self._shared, unscaled
        )
        self._unscaled = tuple(unscaled)
        self._rigid = np.array([column.is_inertial for column in self.columns])
        self._at = {(one.joint, one.kind): at for at, one in enumerate(self.columns)}
        self.prior = self._prior(realization)

    def matrix(
        self,
        position: FloatArray,
        velocity: FloatArray,
        acceleration: FloatArray,
        base: BaseStates | None = None,
    ) -> FloatArray:
        """(n, joints, p) regressor, the derivative of the effort by the parameters, at n instants.

        Args:
            position: (n, joints) rad or m.
            velocity: (n, joints) rad/s or m/s. At 0 the direction of Coulomb friction is unknown
                and its column is 0.
            acceleration: (n, joints) rad/s^2 or m/s^2.
            base: motion of the floating base that carries the joints; at rest by default.
        """
        n, count = position.shape
        found = np.zeros((n, count, len(self.columns)))
        bodies = self._dynamics.regressor(position, velocity, acceleration, base)
        for at, link in enumerate(self._dynamics.links):
            start = self._at[link, INERTIAL[0]]
            found[:, :, start : start + len(INERTIAL)] = bodies[:, :, at]
        for joint in self._unscaled:
            row = self.joints.index(joint)
            scale = found[:, row] @ np.where(self._rigid, self.prior, 0.0)
            found[:, row] = 0.0
            found[:, row, self._at[joint, EffortScale.id]] = scale
        for row, joint, effect in self._drives():
            of_drive = effect.regressor_column(
                position[:, row], velocity[:, row], acceleration[:, row]
            )
            found[:, row, self._at[joint, effect.id]] = of_drive.effort
        for motor in self._shared:
            one, two = self.joints.index(motor.joint), self.joints.index(motor.other)
            ratio = motor.ratio
            direction = np.sign(velocity[:, one] + ratio * velocity[:, two])
            for kind, values in (
                ("coupled_armature", acceleration),
                ("coupled_viscous_friction", velocity),
            ):
                column = self._at[motor.joint, kind]
                found[:, one, column] = ratio * values[:, two]
                found[:, two, column] = ratio * values[:, one]
            column = self._at[motor.joint, "coupled_coulomb_friction"]
            found[:, one, column] = direction
            found[:, two, column] = ratio * direction
        return found

    def random_matrix(self, samples: int, seed: int = 0) -> FloatArray:
        """(samples, joints, p) regressor at random instants, which excite all that can move.

        Args:
            seed: seed of the random motion.
        """
        random = np.random.default_rng(seed)
        position, speed, change = random.uniform(-np.pi, np.pi, (3, samples, len(self.joints)))
        if not self.has_moving_base:
            return self.matrix(position, speed, change)
        pose = np.hstack([np.zeros((samples, 3)), random.standard_normal((samples, 4))])
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        velocity, acceleration = random.uniform(-np.pi, np.pi, (2, samples, 6))
        return self.matrix(position, speed, change, (pose, velocity, acceleration))

    def derivatives(
        self,
        position: FloatArray,
        velocity: FloatArray,
        acceleration: FloatArray,
        parameters: FloatArray,
        base: BaseStates | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Derivatives of the effort ``matrix(motion) @ parameters`` with respect to the motion.

        The direction of dry friction is constant.

        Args:
            position, velocity, acceleration: (n, joints) as for :meth:`matrix`.
            parameters: (p,) parameters.
            base: as for :meth:`matrix`.

        Returns:
            (n, joints, joints) by position, by velocity, and by acceleration; the last index is
            the joint that moves.
        """
        motion = position, velocity, acceleration
        found = self._dynamics.derivatives(*motion, self._links_of(parameters), base)
        if self._unscaled:
            nominal = self._dynamics.derivatives(*motion, self._links_of(self.prior), base)
            for joint in self._unscaled:
                row = self.joints.index(joint)
                scale = parameters[self._at[joint, EffortScale.id]]
                for own, per_scale in zip(found, nominal, strict=True):
                    own[:, row] = scale * per_scale[:, row]
        by_position, by_velocity, by_acceleration = found
        for row, joint, effect in self._drives():
            value = parameters[self._at[joint, effect.id]]
            of_drive = effect.regressor_column(
                position[:, row], velocity[:, row], acceleration[:, row]
            )
            by_position[:, row, row] += value * of_drive.by_position
            by_velocity[:, row, row] += value * of_drive.by_velocity
            by_acceleration[:, row, row] += value * of_drive.by_acceleration
        for motor in self._shared:
            one, two = self.joints.index(motor.joint), self.joints.index(motor.other)
            for kind, own in (
                ("coupled_armature", by_acceleration),
                ("coupled_viscous_friction", by_velocity),
            ):
                coupled = motor.ratio * parameters[self._at[motor.joint, kind]]
                own[:, one, two] += coupled
                own[:, two, one] += coupled
        return found

    def _links_of(self, parameters: FloatArray) -> FloatArray:
        """(links, 10) inertial parameters of the links."""
        starts = [self._at[link, INERTIAL[0]] for link in self._dynamics.links]
        return np.array([parameters[start : start + len(INERTIAL)] for start in starts])

    def _prior(self, realization: NamedModel) -> FloatArray:
        values = np.zeros(len(self.columns))
        for link, stated in zip(self._dynamics.links, self._dynamics.parameters, strict=True):
            start = self._at[link, INERTIAL[0]]
            values[start : start + len(INERTIAL)] = stated
        model = realization.model
        for row, joint in enumerate(self.joints):
            dof = realization.joint_dof_index(joint)
            if joint in self._unscaled:
                continue
            for kind, field in mjcf_fields().items():
                values[self._at[joint, kind]] = getattr(model, f"dof_{field}")[dof]
            values[self._at[joint, Armature.id]] = self._dynamics.armature[row]
        return values

    def _drives(self) -> Iterator[tuple[int, str, Effect]]:
        """Row, joint and effect of each column of a drive."""
        for row, joint in enumerate(self.joints):
            for effect in drive_effects():
                yield row, joint, effect
