"""Initial memory of effects where a window starts in motion.

The state of an elastic transmission, a lag or bristle friction is not measured. The effects alone
are therefore stepped along the measured motion before the window. Memories of commands only, such
as a rate limit, which may lag by seconds, start with all earlier commands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Values, World
from pytest_twin.effects.fast_clip import fast_clip
from pytest_twin.effects.motor_side import Gear, Motor, MotorSide

WARM_UP_TIME = 0.2
"""Length of the motion before a window in s; transmissions and current loops settle sooner."""
PATH_TIMESTEP = 0.01
"""Longest step along a path, s."""

Hooks = Mapping[str, Sequence[tuple[Effect, Values]]]


def run_hooks(world: World, hooks: Hooks, *, drives: bool = True) -> FloatArray:
    """Run all hooks of one step.

    Args:
        world: state of the rows; changed.
        hooks: hook -> effects with their values.
        drives: whether the drives' effort is needed; an elastic transmission always needs it.

    Returns:
        (rows, joints) effort of the control laws within their limits, before effects of the drive.
        ``world.delivered`` is the effort after them. Both are unchanged if not needed.
    """
    gear_effects = hooks["gear"]
    if gear_effects:
        if world.motor is None:
            world.motor = _motor_side(world, gear_effects)
        world.motor.begin_step(world.position, world.velocity)
    for effect, v in hooks["command"]:
        effect.command(world, v)
    world.limit_setpoint()
    for effect, v in hooks["servo"]:
        effect.servo(world, v)
    native = world.delivered
    if drives or gear_effects:
        law = world.control_effort(world.motor_position, world.motor_velocity)
        native = world.delivered = fast_clip(law, world.lower, world.upper)
    for effect, v in hooks["drive"]:
        effect.drive(world, v)
    for effect, v in hooks["friction"]:
        effect.friction(world, v)
    for effect, v in hooks["force"]:
        effect.force(world, v)
    if world.motor is not None:
        world.applied += world.motor.step(
            world.position, world.velocity, world.delivered, is_free=native == law,
            servo_damping=world.damping, friction_level=world.friction_level,
            timestep=world.timestep,
        )  # fmt: skip
    return native


def build_transmission(world: World, gear_effects: Sequence[tuple[Effect, Values]]) -> Gear:
    """The transmission with all effects on it."""
    gear = Gear.rigid(world.motor_armature)
    for effect, v in gear_effects:
        effect.gear(gear, world, v)
    return gear


def shift_motors(
    world: World, gear_effects: Sequence[tuple[Effect, Values]], shift: FloatArray
) -> None:
    """Shift the initial positions of motors behind elastic transmissions by (rows, joints)."""
    if world.motor is None:
        world.motor = _motor_side(world, gear_effects)
    world.motor.position = world.motor.position + shift


def _motor_side(world: World, gear_effects: Sequence[tuple[Effect, Values]]) -> MotorSide:
    return MotorSide.at_rest(
        build_transmission(world, gear_effects), world.position, world.velocity, world.load,
        Motor(
            world.motor_armature, world.motor_damping, world.motor_constant_effort,
            world.damping + world.stiffness * world.timestep,
        ),
        world.timestep,
    )  # fmt: skip


def update_fading_memories(
    world: World, effects: Sequence[tuple[Effect, Values]], path: FloatArray
) -> None:
    """Bring memories that fade with the distance travelled up to date.

    Args:
        world: rows at their start.
        effects: effects with such a memory.
        path: (steps, rows, joints) distance travelled in each step, rad or m.
    """
    saved = {n: getattr(world, n) for n in ("velocity", "applied", "timestep")}
    world.timestep = PATH_TIMESTEP
    for moved in path:
        world.velocity, world.applied = moved / PATH_TIMESTEP, np.zeros_like(moved)
        for effect, v in effects:
            effect.force(world, v)
    for name, value in saved.items():
        setattr(world, name, value)


def warm_up(
    world: World, hooks: Hooks, position: FloatArray, velocity: FloatArray, command: FloatArray
) -> None:
    """Step effects along the motion before the start of ``world``; only their memory changes.

    Args:
        world: rows at their start.
        hooks: hook -> effects with their values.
        position, velocity: (steps, rows, joints) motion before the start, rad or m, and per s.
        command: (steps, rows, joints) commands as they reach the drive.
    """
    saved = {n: getattr(world, n) for n in _RESTORED}
    steps = len(position)
    for k in range(steps):
        world.time = saved["time"] - (steps - k) * world.timestep
        world.position, world.velocity = position[k], velocity[k]
        world.setpoint = command[k].copy()
        world.applied = np.zeros_like(world.applied)
        world.friction_level = saved["friction_level"]
        run_hooks(world, hooks)
        world.lower, world.upper = saved["lower"], saved["upper"]
    for name, value in saved.items():
        setattr(world, name, value)


_RESTORED = (
    "time", "position", "velocity", "setpoint", "delivered", "applied", "friction_level", "lower",
    "upper",
)  # fmt: skip
