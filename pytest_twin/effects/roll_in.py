"""What laws remember where a window starts amid a motion: they live through what came before it.

A motor behind a gear that gives, a drive that lags, a contact that yields: their state is no
reading. Where the joint was is known all the same, and its commands too, so the laws alone are
stepped along the measured motion for a while. What they hold at the end of it is their start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pytest_twin.effects.base import Effect, FloatArray, Values, World

LEAD = 0.2
"""s; motors behind gears and current loops forget sooner."""

Hooks = Mapping[str, Sequence[tuple[Effect, Values]]]


def act(world: World, hooks: Hooks) -> None:
    """Every law of one step up to the transmission, at the setpoint and the motion at hand."""
    for effect, v in hooks["command"]:
        effect.command(world, v)
    for effect, v in hooks["servo"]:
        effect.servo(world, v)
    law = world.asked(world.position, world.velocity)
    world.delivered = np.minimum(np.maximum(law, world.lower), world.upper)
    for effect, v in hooks["drive"]:
        effect.drive(world, v)
    for effect, v in hooks["friction"]:
        effect.friction(world, v)
    for effect, v in hooks["force"]:
        effect.force(world, v)


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
        for effect, v in hooks["transmit"]:
            effect.transmit(world, v)
        world.lower, world.upper = kept["lower"], kept["upper"]
    for name, value in kept.items():
        setattr(world, name, value)


_BORROWED = (
    "time", "position", "velocity", "setpoint", "delivered", "applied", "friction_level", "lower",
    "upper",
)  # fmt: skip
