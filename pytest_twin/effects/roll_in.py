"""What laws remember where a window starts amid a motion: they live through what came before it.

A motor behind a gear that gives, a drive that lags, a contact that yields: their state is no
reading. Where the joint was is known all the same, and its commands too, so the laws alone are
stepped along the measured motion for a while. What they hold at the end of it is their start.
What follows commands alone (a setpoint that moves no faster than its profile allows may be seconds
behind) begins that with all that were sent before: no motion has to be known for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Values, World
from pytest_twin.effects.motor_side import Gear, MotorSide
from pytest_twin.effects.within import within

LEAD = 0.2
"""s; motors behind gears and current loops forget sooner."""
PATH_STEP = 0.01
"""s; longest step along a path."""

Hooks = Mapping[str, Sequence[tuple[Effect, Values]]]


def act(world: World, hooks: Hooks, *, drives: bool = True) -> FloatArray:
    """Every law of one step, at the setpoint and the motion at hand.

    Args:
        world: rows at their state.
        hooks: hook -> effects with their values.
        drives: whether anybody asks what the drives deliver; a gear that gives does.

    Returns:
        (rows, joints) what the drives' own laws give within their bounds, before effects of the
        drive; ``world.delivered`` is after them. As they were where nobody asks.
    """
    geared = hooks["gear"]
    if geared:
        if world.motor is None:
            world.motor = _motor_side(world, geared)
        world.motor.meet(world.position, world.velocity)
    for effect, v in hooks["command"]:
        effect.command(world, v)
    for effect, v in hooks["servo"]:
        effect.servo(world, v)
    native = world.delivered
    if drives or geared:
        law = world.asked(world.motor_position, world.motor_velocity)
        native = world.delivered = within(law, world.lower, world.upper)
    for effect, v in hooks["drive"]:
        effect.drive(world, v)
    for effect, v in hooks["friction"]:
        effect.friction(world, v)
    for effect, v in hooks["force"]:
        effect.force(world, v)
    if world.motor is not None:
        world.applied += world.motor.step(
            world.position, world.velocity, world.delivered, free=native == law,
            servo_damping=world.damping, friction_level=world.friction_level,
            timestep=world.timestep,
        )  # fmt: skip
    return native


def gears(world: World, geared: Sequence[tuple[Effect, Values]]) -> Gear:
    """What stands between motors and links, all laws of it together."""
    gear = Gear.rigid(world.motor_armature)
    for effect, v in geared:
        effect.gear(gear, world, v)
    return gear


def shift_motors(world: World, geared: Sequence[tuple[Effect, Values]], shift: FloatArray) -> None:
    """Let motors behind gears that give start (rows, joints) apart from where they would."""
    if world.motor is None:
        world.motor = _motor_side(world, geared)
    world.motor.angle = world.motor.angle + shift


def _motor_side(world: World, geared: Sequence[tuple[Effect, Values]]) -> MotorSide:
    return MotorSide.at_rest(
        gears(world, geared), world.position, world.velocity, world.load,
        armature=world.motor_armature, damping=world.motor_damping, constant=world.motor_constant,
        servo=world.damping + world.stiffness * world.timestep, timestep=world.timestep,
    )  # fmt: skip


def follow(world: World, effects: Sequence[tuple[Effect, Values]], path: FloatArray) -> None:
    """Let forces that fade with the way that joints go see the way up to the lead.

    Args:
        world: rows at their start.
        effects: those whose memory fades with the way.
        path: (steps, rows, joints) rad or m that joints go in each step, the last ending at the
            lead.
    """
    kept = {n: getattr(world, n) for n in ("velocity", "applied", "timestep")}
    world.timestep = PATH_STEP
    for moved in path:
        world.velocity, world.applied = moved / PATH_STEP, np.zeros_like(moved)
        for effect, v in effects:
            effect.force(world, v)
    for name, value in kept.items():
        setattr(world, name, value)


def roll_in(
    world: World, hooks: Hooks, position: FloatArray, velocity: FloatArray, command: FloatArray
) -> None:
    """Step laws along a motion up to the start of ``world``; only their memory changes.

    Args:
        world: rows at their start.
        hooks: hook -> effects with their values, as they act between steps.
        position, velocity: (steps, rows, joints) of the motion before, rad or m and per s.
        command: (steps, rows, joints) held commands, as they reach the drive.
    """
    kept = {n: getattr(world, n) for n in _BORROWED}
    steps = len(position)
    for k in range(steps):
        world.time = kept["time"] - (steps - k) * world.timestep
        world.position, world.velocity = position[k], velocity[k]
        world.setpoint = command[k].copy()
        world.applied = np.zeros_like(world.applied)
        world.friction_level = kept["friction_level"]
        act(world, hooks)
        world.lower, world.upper = kept["lower"], kept["upper"]
    for name, value in kept.items():
        setattr(world, name, value)


_BORROWED = (
    "time", "position", "velocity", "setpoint", "delivered", "applied", "friction_level", "lower",
    "upper",
)  # fmt: skip
