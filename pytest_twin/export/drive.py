"""Drives of a model as MuJoCo actuators that hold more than a linear law.

A linear servo becomes a ``pid`` or a ``dcmotor`` as soon as an effect needs it. All effects of one
drive share one actuator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from pytest_twin.realization.engine import HAS_CONTROL_INPUTS, SETPOINT_BITS, set_to_pid
from pytest_twin.trial import CommandMode

_BITS = dict(SETPOINT_BITS)
SMALL_CONSTANT = 1e-6
"""Motor constant of a ``dcmotor`` without a torque-speed limit, N*m/A and V*s/rad: its back-EMF is
far below the voltage that one N*m needs here, 1 V. MuJoCo 3.17 refuses 0."""


@dataclass(slots=True)
class DriveLaw:
    """What one drive does beyond a linear law; SI units, at the actuator.

    Attributes:
        lag: time constant of the effort, s.
        slew: largest rate of the setpoint, rad/s, m/s, N*m/s or N/s; 0 for no limit.
        integral_time: gain divided by integral gain, s; 0 without an integral term.
        stall, no_load_speed: torque-speed limit, N*m and rad/s or N and m/s; 0 for none.
    """

    lag: float = 0.0
    slew: float = 0.0
    integral_time: float = 0.0
    stall: float = 0.0
    no_load_speed: float = 0.0


def write_drive(
    actuator: mujoco.MjsActuator, mode: CommandMode, law: DriveLaw, *, constant: float = 0.0
) -> str | None:
    """Turn a linear drive into an actuator with this law.

    Args:
        actuator: a linear actuator, changed in place.
        mode: quantity of its command.
        law: what it does beyond its linear law.
        constant: constant force of its law, N*m or N, which a ``dcmotor`` has no place for.

    Returns:
        Name of the MJCF element, or None if MuJoCo has no actuator with this law.
    """
    if not HAS_CONTROL_INPUTS:
        return None
    gain, damping = float(actuator.gainprm[0]), -float(actuator.biasprm[2])
    force_range = np.array(actuator.forcerange)
    is_limited = actuator.forcelimited != mujoco.mjtLimited.mjLIMITED_FALSE and (
        force_range[0] < force_range[1]
    )
    is_servo = mode == "position" and gain == -float(actuator.biasprm[1]) != 0.0
    is_velocity = mode == "velocity" and gain == damping and actuator.biasprm[1] == 0.0
    if not (is_servo or is_velocity or mode == "effort") or actuator.dyntype != 0:
        return None
    needs_motor = law.lag > 0.0 or law.no_load_speed > 0.0
    if mode == "effort" and gain != 1.0 and law.slew > 0.0:
        return None
    if law.integral_time > 0.0 and not is_servo:
        return None
    kp = gain if is_servo else 0.0
    ki = kp / law.integral_time if law.integral_time > 0.0 else 0.0
    if not needs_motor:
        set_to_pid(
            actuator, kp=kp, kv=damping, ki=ki if ki else -1.0,
            slewmax=law.slew if law.slew > 0.0 else -1.0, ctrlspec=_BITS[mode],
        )  # fmt: skip
        actuator.biasprm[0] = constant
        _set_range(actuator, force_range, is_limited)
        return "pid"
    if constant or (mode == "effort" and gain != 1.0):
        return None
    if is_limited and force_range[0] != -force_range[1]:
        return None
    most = float(force_range[1]) if is_limited else math.inf
    voltage = 0.0
    motor_constant, resistance = SMALL_CONSTANT, SMALL_CONSTANT
    if law.no_load_speed > 0.0:
        # K = V / no-load speed, stall = K V / R; the voltage itself is free.
        voltage = law.stall
        motor_constant = voltage / law.no_load_speed
        resistance = motor_constant * voltage / law.stall
        most = min(most, law.stall)
    elif is_limited:
        # The voltage limits the effort before its lag, as the limit of a current controller.
        voltage = most
    actuator.set_to_dcmotor(
        motorconst=[motor_constant, motor_constant], resistance=resistance,
        controller=[kp, ki, damping, law.slew, 0.0, voltage],
        inductance=[0.0, law.lag], ctrlspec=_BITS[mode],
    )  # fmt: skip
    _set_range(actuator, np.array([-most, most]), math.isfinite(most))
    return "dcmotor"


def _set_range(actuator: mujoco.MjsActuator, force_range: np.ndarray, is_limited: bool) -> None:
    if is_limited:
        actuator.forcerange = force_range
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
