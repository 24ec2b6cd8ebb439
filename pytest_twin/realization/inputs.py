"""Map a joint command to the control input of an actuator, with its scale."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from pytest_twin.errors import SpecError
from pytest_twin.realization.engine import DYN_PID, GAIN_PID, SETPOINT_BITS
from pytest_twin.trial import CommandMode

# Integers, because a MuJoCo enum on the left of == does not compare with a NumPy integer.
_SCALAR_JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
JOINT_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
LINEAR_GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_SETPOINT_GAINS = (GAIN_PID, int(mujoco.mjtGain.mjGAIN_DCMOTOR))


@dataclass(frozen=True, slots=True)
class CommandInput:
    """One control input of an actuator that drives a joint.

    Attributes:
        mode: quantity of the setpoint: ``position``, ``velocity`` or ``effort``.
        control: index into ``ctrl``.
        scale: ``ctrl = scale * command``, the command in rad, rad/s or N*m of the joint (m, m/s
            or N where it slides).
    """

    mode: CommandMode
    control: int
    scale: float
    actuator: int


def joint_inputs(model: mujoco.MjModel, joint: str) -> list[CommandInput]:
    """All control inputs of a hinge or slide joint for position, velocity or effort.

    Only actuators that drive the joint directly are included. The force of an actuator is
    ``gain * u + b0 + b1 * length + b2 * velocity``. A position servo is therefore at rest for
    ``u = -b1 / gain * length``, and a velocity servo for ``u = -b2 / gain * velocity``.
    """
    joint_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    found: list[CommandInput] = []
    if joint_id < 0 or int(model.jnt_type[joint_id]) not in _SCALAR_JOINTS:
        return found
    for actuator in range(model.nactuator):
        if int(model.actuator_trntype[actuator]) not in JOINT_TRANSMISSIONS:
            continue
        if model.actuator_trnid[actuator, 0] == joint_id:
            found += _actuator_inputs(model, actuator)
    return found


def command_input(model: mujoco.MjModel, joint: str, mode: CommandMode) -> CommandInput | None:
    """The control input of ``joint`` for commands of ``mode``.

    None for an effort command of a joint without actuator, which is applied to the joint itself.

    Raises:
        SpecError: the joint has no control input for this mode, or more than one.
    """
    inputs = joint_inputs(model, joint)
    fitting = [item for item in inputs if item.mode == mode]
    if len(fitting) == 1:
        return fitting[0]
    names = ", ".join(f"{_actuator_name(model, i.actuator)} ({i.mode})" for i in inputs)
    if fitting:
        raise SpecError(
            f"more than one actuator takes {mode} commands",
            where=f"joint '{joint}'",
            value=names,
            expected="one",
        )
    if mode == "effort" and not inputs:
        return None
    raise SpecError(
        f"no actuator takes {mode} commands",
        where=f"joint '{joint}'",
        value=names or "no actuator",
        expected=f"an actuator of this joint with {mode} as its input",
    )


def steady_activation(
    model: mujoco.MjModel, data: mujoco.MjData, actuator: int
) -> tuple[int, float] | None:
    """Steady state of an actuator under ``data.ctrl``: (index into ``act``, value), or None.

    Filters and rate limits have reached their control, integrators hold the position of the joint.
    Integral terms, currents, temperatures and friction states stay at zero, because no recording
    states them.

    Args:
        data: contains positions, transmission lengths and controls.
    """
    address = int(model.actuator_actadr[actuator])
    if address < 0 or not model.actuator_ctrlnum[actuator]:
        return None
    control = float(data.ctrl[model.actuator_ctrladr[actuator]])
    dynamics = int(model.actuator_dyntype[actuator])
    dyn = mujoco.mjtDyn
    slew_limit = {DYN_PID: 1, int(dyn.mjDYN_DCMOTOR): 7}.get(dynamics)
    if dynamics in (dyn.mjDYN_FILTER, dyn.mjDYN_FILTEREXACT, dyn.mjDYN_MUSCLE):
        return address, control
    if dynamics == dyn.mjDYN_INTEGRATOR:
        gain = float(model.actuator_gainprm[actuator, 0])
        stiffness = -float(model.actuator_biasprm[actuator, 1])
        length = float(data.actuator_length[model.actuator_outadr[actuator]])
        return (address, stiffness / gain * length) if gain else None
    if slew_limit is not None and model.actuator_dynprm[actuator, slew_limit] > 0:
        return address, control
    return None


def _actuator_inputs(model: mujoco.MjModel, actuator: int) -> list[CommandInput]:
    control = int(model.actuator_ctrladr[actuator])
    gear = float(model.actuator_gear[model.actuator_outadr[actuator], 0])
    declared = int(model.actuator_ctrlspec[actuator])
    gain_type = int(model.actuator_gaintype[actuator])
    if gear == 0.0:
        return []
    if gain_type in _SETPOINT_GAINS:
        # Setpoints are in actuator length, a feedforward in actuator force.
        present = [setpoint for setpoint, bit in SETPOINT_BITS if declared & bit]
        return [
            CommandInput(item, control + at, 1.0 / gear if item == "effort" else gear, actuator)
            for at, item in enumerate(present)
        ]
    if gain_type not in LINEAR_GAINS:
        return []
    gain = float(model.actuator_gainprm[actuator, 0])
    if gain == 0.0:
        return []
    stiffness, damping = (-float(b) for b in model.actuator_biasprm[actuator, 1:3])
    integrates = model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_INTEGRATOR
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE:
        if integrates or gain_type != mujoco.mjtGain.mjGAIN_FIXED:
            return []
        return [CommandInput("effort", control, 1.0 / (gain * gear), actuator)]
    if model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE:
        return []
    if stiffness != 0.0:
        mode: CommandMode = "velocity" if integrates else "position"
        return [CommandInput(mode, control, gear * stiffness / gain, actuator)]
    if damping != 0.0 and not integrates:
        return [CommandInput("velocity", control, gear * damping / gain, actuator)]
    return []


def _actuator_name(model: mujoco.MjModel, actuator: int) -> str:
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator)
    return name or f"actuator {actuator}"
