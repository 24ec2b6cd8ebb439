"""Simulate the robot's closed-loop response to a motion's commands."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import SimulationError, SpecError
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.motion import Motion
from pytest_twin.open_loop import Row, replay_rows
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.first_state import follow_joint_equalities
from pytest_twin.realization.inputs import LINEAR_GAINS, command_input, joint_inputs
from pytest_twin.realization.model import Realization
from pytest_twin.recording_options import CommandMode
from pytest_twin.trial import Trial

WORSE = 1.2
"""Factor on masses, inertias, friction and armature of the worse model, for which a motion must
be safe too."""
_GAINS = {"stiffness": 1, "damping": 2}
"""Gain of a servo -> its index in ``biasprm``."""
_CHANGE = 0.02
"""Relative change of a gain in the difference quotient."""
SETTLE = 2.0
"""Time at rest before the motion, s, in which servos settle under gravity."""


@dataclass(frozen=True, slots=True)
class Response:
    """Response of a model to commands, in the model's sign and zero.

    Attributes:
        position, velocity, effort: (n, j) at the motion's stamps, SI units.
        error: error of a diverged simulation, whose later values are NaN, or None.
    """

    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
    error: SimulationError | None = None


class ClosedLoop:
    """One robot with a payload, as the nominal model or one scaled by a factor.

    If every joint has a position or velocity servo, these are simulated. Otherwise all joints
    follow their commands exactly, and efforts come from inverse dynamics.

    Args:
        realization: the model, with the payload.
        approved: limits, with the commanded joints.
        factor: factor on all masses, inertias, friction and armature.
    """

    def __init__(
        self, realization: Realization, approved: ApprovedLimits, factor: float = 1.0
    ) -> None:
        self._realization = realization
        self._approved = approved
        self._model = (
            realization.model if factor == 1.0 else scaled_model(realization.model, factor)
        )
        self._joint_ids = [realization.joint_index(name) for name in approved.names]
        self._dofs = self._model.jnt_dofadr[self._joint_ids]
        self.modes = servo_modes(realization, approved.names)

    def responses(self, motions: Sequence[Motion]) -> list[Response]:
        """Return the response to each motion."""
        if self.modes is None:
            return [self._ideal_response(motion) for motion in motions]
        rows = [self._row(motion, self._model) for motion in motions]
        return [
            Response(
                replayed.position[1:], replayed.velocity[1:], replayed.effort[1:], replayed.error
            )
            for replayed in replay_rows(rows)
        ]

    def servo_derivatives(
        self, motion: Motion, joint: int
    ) -> dict[str, tuple[float, str, FloatArray]]:
        """Compute the derivatives of a joint's motion by the gains of its servo.

        Returns:
            ``stiffness`` and ``damping`` -> nominal value at the joint, its unit, and the
                derivative (n,) of the joint's position by the value, in rad or m per unit.
        """
        if self.modes is None or self.modes[joint] != "position":
            return {}
        limits = self._approved.joints[joint]
        actuators = [
            one.actuator
            for one in joint_inputs(self._model, limits.name)
            if one.mode == "position"
            and int(self._model.actuator_gaintype[one.actuator]) in LINEAR_GAINS
        ]
        if len(actuators) != 1:
            return {}
        gear = float(self._model.actuator_gear[self._model.actuator_outadr[actuators[0]], 0])
        found, rows = {}, [self._row(motion, self._model)]
        for name, place in _GAINS.items():
            value = -(gear**2) * float(self._model.actuator_biasprm[actuators[0], place])
            if value > 0.0:
                changed = copy.copy(self._model)
                changed.actuator_biasprm[actuators[0], place] *= 1.0 + _CHANGE
                if name == "stiffness":
                    changed.actuator_gainprm[actuators[0], 0] *= 1.0 + _CHANGE
                rows.append(self._row(motion, changed))
                per = "" if name == "stiffness" else "*s"
                found[name] = (value, f"{limits.effort_unit}{per}/{limits.unit}")
        positions = [replayed.position[1:, joint] for replayed in replay_rows(rows)]
        return {
            name: (value, unit, (position - positions[0]) / (_CHANGE * value))
            for (name, (value, unit)), position in zip(found.items(), positions[1:], strict=True)
        }

    def _row(self, motion: Motion, model: mujoco.MjModel) -> Row:
        assert self.modes is not None
        trial = trial_of(motion, None, self._approved.names, self.modes)
        return Row(trial, model, {}, self._realization.path)

    def _ideal_response(self, motion: Motion) -> Response:
        """Return the efforts of a robot that follows its commands exactly (inverse dynamics)."""
        model = copy.copy(self._model)
        # Other checks cover contacts and stops; here they would add forces.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        data = mujoco.MjData(model)
        columns = model.jnt_qposadr[self._joint_ids]
        effort = np.empty_like(motion.position)
        for at in range(len(motion.time)):
            data.qpos[:] = model.qpos0
            data.qvel[:] = 0.0
            data.qacc[:] = 0.0
            data.qpos[columns] = motion.position[at]
            data.qvel[self._dofs] = motion.velocity[at]
            data.qacc[self._dofs] = motion.acceleration[at]
            follow_joint_equalities(model, data, set(self._joint_ids))
            mujoco.mj_inverse(model, data)
            effort[at] = data.qfrc_inverse[self._dofs]
        return Response(motion.position, motion.velocity, effort)


def trial_of(
    motion: Motion,
    realization: Realization | None,
    names: tuple[str, ...],
    modes: tuple[CommandMode, ...],
) -> Trial:
    """Return the trial that commands a motion after ``SETTLE`` at rest.

    Args:
        realization: the model whose encoders read the positions; None for positions in the model's
            sign and zero.
        names, modes: (j,) joints and their command modes.
    """
    calibration = {} if realization is None else calibration_of(realization)
    encoders = Encoders.of(calibration, names)
    position = encoders.read_position(motion.position)
    by_velocity = np.array([mode == "velocity" for mode in modes])
    command = np.where(by_velocity, encoders.read_velocity(motion.velocity), position)
    time = np.concatenate([[0.0], SETTLE + motion.time])
    return Trial(
        path=Path(motion.name),
        start=0,
        joints=names,
        time=time,
        position=np.concatenate([position[:1], position]),
        velocity=np.zeros((len(time), len(names))),
        effort=None,
        command_joints=names,
        command_time=time,
        command=np.concatenate([command[:1], command]),
        command_modes=modes,
        metadata={},
        command_between="interpolated",
        between_source="option",
    )


def servo_modes(realization: Realization, joints: Sequence[str]) -> tuple[CommandMode, ...] | None:
    """Return each servo's command, position or velocity; None if a joint has no servo."""
    found: list[CommandMode] = []
    for joint in joints:
        for mode in ("position", "velocity"):
            try:
                taken = command_input(realization.model, joint, mode)
            except SpecError:
                continue
            if taken is not None:
                found.append(mode)
                break
        else:
            return None
    return tuple(found)


def scaled_model(model: mujoco.MjModel, factor: float) -> mujoco.MjModel:
    """Return a copy with masses, inertias, friction and armature times ``factor``.

    Gravity compensation is unchanged, because the controller knows the nominal masses.
    """
    heavier = copy.copy(model)
    for name in (
        "body_mass",
        "body_inertia",
        "dof_damping",
        "dof_dampingpoly",
        "dof_frictionloss",
        "dof_armature",
    ):
        values = getattr(heavier, name)
        values[:] = factor * values
    heavier.body_gravcomp[:] = heavier.body_gravcomp / factor
    mujoco.mj_setConst(heavier, mujoco.MjData(heavier))
    return heavier
