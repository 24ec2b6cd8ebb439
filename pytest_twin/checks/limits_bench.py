"""Measure the response of a joint to commands and forces beyond its limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pytest_twin.checks.fields import POSITION_UNIT
from pytest_twin.checks.poses import configuration
from pytest_twin.realization.joint_limits import drivers_of, model_range

if TYPE_CHECKING:
    import mujoco

    from pytest_twin.realization import Realization

_BEYOND = 1e3  # commands exceed the range by this factor


def _bench(realization: Realization, free: frozenset[str]) -> mujoco.MjModel:
    """Return the robot without gravity and contact, with all joints except ``free`` held."""
    import mujoco

    from pytest_twin.realization import simulate

    held = [joint for joint in realization.joints if joint not in free]
    model = simulate.prepare_model(realization, gravity=False, locked=held)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _start(
    realization: Realization, model: mujoco.MjModel, values: Mapping[str, float]
) -> mujoco.MjData:
    """Return a state at rest with ``values`` (rad or m), other joints at reference or next stop.

    The solver would push a held joint beyond its stop back with full force.
    """
    from pytest_twin.realization import simulate

    robot = realization.model
    inside: dict[str, float] = {}
    for joint in realization.joints:
        if realization.structure.joint_type[joint] in POSITION_UNIT:
            index = realization.joint_index(joint)
            reference = float(robot.qpos0[robot.jnt_qposadr[index]])
            bounds = model_range(robot, index)
            if bounds is not None and not bounds[0] <= reference <= bounds[1]:
                inside[joint] = min(max(reference, bounds[0]), bounds[1])
    return simulate.initial_state(
        model, realization, configuration(realization, inside | dict(values))
    )


def _saturating_command(model: mujoco.MjModel, control: int, sign: float) -> float:
    """Return a command far beyond the actuator's range, or far from zero without a range."""
    largest = 1.0
    if model.actuator_ctrllimited[control]:
        largest = max(1e-3, *(abs(float(end)) for end in model.actuator_ctrlrange[control]))
    return sign * _BEYOND * largest


def _command(
    realization: Realization,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    drivers: list[str],
    sign: float,
) -> None:
    """Set every actuator of a joint to its largest force in the direction of ``sign``."""
    for actuator in drivers:
        i = realization.actuator_index(actuator)
        gear = float(model.actuator_gear[model.actuator_outadr[i], 0])
        control = int(model.actuator_ctrladr[i])
        data.ctrl[control] = _saturating_command(model, control, sign * math.copysign(1.0, gear))


def largest_effort(
    realization: Realization, joint: str, drivers: list[str], duration: float
) -> list[float]:
    """Return smallest and largest generalized force of actuators on the held joint, N*m or N.

    The joint is at the far end of its range, where the force of a servo is largest.
    """
    import mujoco

    from pytest_twin.realization import simulate

    model = _bench(realization, frozenset())
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    dof = realization.joint_dof_index(joint)
    bounds = model_range(realization.model, realization.joint_index(joint))
    reached = []
    for sign in (-1.0, 1.0):
        values = {} if bounds is None else {joint: bounds[0] if sign > 0.0 else bounds[1]}
        data = _start(realization, model, values)
        data.ctrl[:] = simulate.hold(model, data)
        _command(realization, model, data, drivers, sign)
        extreme = 0.0
        for _ in range(simulate.steps_in(model, duration)):
            mujoco.mj_step(model, data)
            simulate.check_finite(model, data)
            force = float(data.qfrc_actuator[dof])
            extreme = max(extreme, force) if sign > 0.0 else min(extreme, force)
        reached.append(extreme)
    return reached


def highest_speed(
    realization: Realization, joint: str, drivers: list[str], duration: float
) -> float:
    """Return the largest speed under the strongest command over the range, rad/s or m/s."""
    import mujoco

    from pytest_twin.realization import simulate

    model = _bench(realization, simulate.coupled_joints(realization, joint))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    address, dof = realization.joint_qpos_index(joint), realization.joint_dof_index(joint)
    bounds = model_range(realization.model, realization.joint_index(joint))
    greatest = 0.0
    for sign in (-1.0, 1.0):
        near, far = (None, math.inf) if bounds is None else (bounds[0], bounds[1])
        if sign < 0.0:
            near, far = (None, -math.inf) if bounds is None else (bounds[1], bounds[0])
        values = {} if near is None else {joint: near}
        data = _start(realization, model, values)
        data.ctrl[:] = simulate.hold(model, data)
        _command(realization, model, data, drivers, sign)
        for _ in range(simulate.steps_in(model, duration)):
            mujoco.mj_step(model, data)
            simulate.check_finite(model, data)
            if sign * float(data.qpos[address]) > sign * far:
                break
            greatest = max(greatest, abs(float(data.qvel[dof])))
    return greatest


def distances_past_stops(
    realization: Realization, joint: str, bounds: list[float], push: float, duration: float
) -> list[float]:
    """Return the distance beyond lower and upper stop under a push from rest, rad or m."""
    import mujoco

    from pytest_twin.realization import simulate

    model = _bench(realization, simulate.coupled_joints(realization, joint))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    address, dof = realization.joint_qpos_index(joint), realization.joint_dof_index(joint)
    passed = []
    for stop, sign in zip(bounds, (-1.0, 1.0), strict=True):
        data = _start(realization, model, {joint: stop})
        data.qfrc_applied[dof] = sign * push
        furthest = 0.0
        for _ in range(simulate.steps_in(model, duration)):
            mujoco.mj_step(model, data)
            simulate.check_finite(model, data)
            furthest = max(furthest, sign * (float(data.qpos[address]) - stop))
        passed.append(furthest)
    return passed


def servo_range(realization: Realization, joint: str) -> list[float] | None:
    """Return the range of setpoints of the joint's position servo, rad or m.

    It follows from the servo's force under extreme commands, which is linear in the clipped
    command. The result is None without a position servo.
    """

    from pytest_twin.realization import simulate

    model = simulate.prepare_model(realization)
    model.actuator_forcelimited[:] = 0
    model.jnt_actfrclimited[:] = 0
    for actuator in drivers_of(realization, joint):
        i = realization.actuator_index(actuator)
        if simulate.command_kind(model, i) == "position":
            return _aim(
                model, simulate.initial_state(model, realization, realization.model.qpos0), i
            )
    return None


def _aim(model: mujoco.MjModel, data: mujoco.MjData, actuator: int) -> list[float] | None:
    """Return smallest and largest setpoint of a servo, rad or m; None behind a filter."""
    import mujoco

    from pytest_twin.realization import simulate

    output, control = int(model.actuator_outadr[actuator]), int(model.actuator_ctrladr[actuator])
    gear = float(model.actuator_gear[output, 0])
    rest = simulate.hold(model, data)

    def force(command: float) -> float:
        data.ctrl[:] = rest
        data.ctrl[control] = command
        mujoco.mj_forward(model, data)
        return float(data.actuator_force[output])

    low, high = float(rest[control]) - 0.1, float(rest[control]) + 0.1
    if model.actuator_ctrllimited[control]:
        lower, upper = (float(end) for end in model.actuator_ctrlrange[control])
        low, high = lower + 0.25 * (upper - lower), lower + 0.75 * (upper - lower)
    at = force(low)
    slope = (force(high) - at) / (high - low)
    if slope == 0.0 or gear == 0.0:
        return None
    return sorted(
        (low + (force(_saturating_command(model, control, sign)) - at) / slope) / gear
        for sign in (-1.0, 1.0)
    )
