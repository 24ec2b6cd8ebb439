"""What a model states of a joint's limits, and what commands and pushes past them reach."""

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

_BEYOND = 1e3  # how many times past its range a command goes


def _bench(realization: Realization, free: frozenset[str]) -> mujoco.MjModel:
    """The robot without gravity and contact, all joints held but ``free``."""
    import mujoco

    from pytest_twin.realization import simulate

    held = [joint for joint in realization.joints if joint not in free]
    model = simulate.bench(realization, gravity=False, locked=held)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _start(
    realization: Realization, model: mujoco.MjModel, values: Mapping[str, float]
) -> mujoco.MjData:
    """At rest with ``values`` (rad or m), the other joints at the reference or their next stop.

    A held joint beyond its stop would be pushed back by the full force of the solver.
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
    return simulate.start(model, realization, configuration(realization, inside | dict(values)))


def _far(model: mujoco.MjModel, control: int, sign: float) -> float:
    """A command far past the actuator's range, or far from zero where it has none."""
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
    """Set every driver of a joint to push it the way of ``sign`` as hard as it can."""
    for actuator in drivers:
        i = realization.actuator_index(actuator)
        gear = float(model.actuator_gear[model.actuator_outadr[i], 0])
        control = int(model.actuator_ctrladr[i])
        data.ctrl[control] = _far(model, control, sign * math.copysign(1.0, gear))


def strongest(
    realization: Realization, joint: str, drivers: list[str], duration: float
) -> list[float]:
    """Least and greatest generalized force of the actuators on the held joint, N*m or N.

    The joint stands at the far end of its range, where a servo pulls hardest.
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


def fastest(realization: Realization, joint: str, drivers: list[str], duration: float) -> float:
    """Greatest speed under the strongest command from one end of the range to the other."""
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


def pushed_past(
    realization: Realization, joint: str, bounds: list[float], push: float, duration: float
) -> list[float]:
    """How far past its lower and upper stop a joint gets, in rad or m, pushed from rest there."""
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
    """Joint positions that the joint's position servo aims at when commanded far past them.

    None where no position servo drives the joint. The aim follows from the servo's force, which
    is linear in the command up to where the command is clipped.
    """

    from pytest_twin.realization import simulate

    model = simulate.bench(realization)
    model.actuator_forcelimited[:] = 0
    model.jnt_actfrclimited[:] = 0
    for actuator in drivers_of(realization, joint):
        i = realization.actuator_index(actuator)
        if simulate.command_kind(model, i) == "position":
            return _aim(model, simulate.start(model, realization, realization.model.qpos0), i)
    return None


def _aim(model: mujoco.MjModel, data: mujoco.MjData, actuator: int) -> list[float] | None:
    """Lower and upper joint position that a servo aims at; None behind a filter."""
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
        (low + (force(_far(model, control, sign)) - at) / slope) / gear for sign in (-1.0, 1.0)
    )
