"""Plant of the family ``other engines``: a robot in Drake or Bullet with sampled servos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from cell import Background, Cell
from cell_plant import gravity_of, joined
from engine_drive import MEMORY, axes_of, drive, timing_of
from plant import Hidden
from robots import Robot
from setpoints import FINE

SETTLE = 0.5
"""Time before a recording in which the robot comes to rest at the first setpoint, s."""
ENGINES = ("drake", "bullet")


class Mechanics(Protocol):
    """A robot in an engine."""

    def reset(self, position: np.ndarray) -> None:
        """Put the joints at rest."""

    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(joints,) positions and velocities of the links and of the motors."""

    def advance(self, effort: np.ndarray, level: np.ndarray) -> None:
        """One step under efforts of the joints and dry friction of some level."""

    def close(self) -> None:
        """Release the engine."""


@dataclass
class Run:
    """Simulated motion of a robot; arrays are (steps of the engine, recordings, joints).

    Attributes:
        period: time between steps, s.
        position, velocity, effort: exact sensor readings.
        demand: efforts that the servos demand, N*m.
    """

    period: float
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    demand: np.ndarray


def mechanics(
    engine: str, robot: Robot, real: Hidden, background: Background
) -> tuple[Mechanics, float]:
    """Return a robot in an engine, and the engine's time step, s."""
    gravity = gravity_of(real)
    if engine == "drake":
        import engine_drake

        return engine_drake.DrakeRobot(robot, real, background, gravity), engine_drake.STEP
    import engine_bullet

    return engine_bullet.BulletRobot(robot, real, background, gravity), engine_bullet.STEP


def named(engine: str) -> tuple[str, ...]:
    """Return the effects that can be hidden in an engine, in addition to those of a contact."""
    if engine == "drake":
        import engine_drake

        return engine_drake.NAMED
    import engine_bullet

    return engine_bullet.NAMED


def simulate(
    engine: str, robot: Robot, cell: Cell, hidden: Hidden, background: Background,
    reference: np.ndarray,
) -> Run:  # fmt: skip
    """Simulate a robot in an engine under setpoints (milliseconds, recordings, joints)."""
    real = joined(hidden, background)
    body, step = mechanics(engine, robot, real, background)
    fine, rows, n = reference.shape
    steps, first = round(fine * FINE / step), -round(SETTLE / step)
    axes, timing = axes_of(robot, cell, real, step), timing_of(robot, cell, step)
    position, velocity, effort, demand = (np.zeros((steps, rows, n)) for _ in range(4))
    made, total, level = np.zeros(n), np.zeros(n), np.zeros(n)
    for r in range(rows):
        ref = np.ascontiguousarray(reference[:, r])
        begin = np.zeros(n) if robot.mode == "velocity" else ref[0] - axes["bias"]
        body.reset(begin)
        memory = np.zeros(n, MEMORY)
        memory["read"], memory["held"], memory["due"] = begin + axes["bias"], ref[0], first
        for k in range(first, steps):
            q, v, motor, speed = body.state()
            drive(k, k == first, timing, axes, memory, ref, q, motor, speed, made, total, level)
            if k >= 0:
                position[k, r], velocity[k, r] = q, v
                effort[k, r], demand[k, r] = made, memory["applied"]
            body.advance(total, level)
    body.close()
    raw = position
    position = raw * (1 + real.get("encoder_scale", "scale_error", n))
    position += real.get("encoder_bias", "bias", n)
    position += real.get("encoder_eccentricity", "sine", n) * np.sin(raw)
    position += real.get("encoder_eccentricity", "cosine", n) * (np.cos(raw) - 1)
    velocity *= 1 + real.get("encoder_scale", "scale_error", n)
    return Run(step, position, velocity, effort, demand)
