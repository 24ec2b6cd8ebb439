"""Setpoints of blind cases as functions of time, as a motion planner would send them.

There is one row per millisecond. The plant determines their interpolation (held, interpolated,
ramped).
"""

from __future__ import annotations

import numpy as np
from robots import Robot

FINE = 1e-3
"""Time between the rows of a setpoint, s."""
KINDS = ("multisine", "moves", "slow", "steps", "chirp")
"""Kinds of motion of the five recordings of a case, in this order; held-out ones vary."""
VELOCITY_BOUND = 2.0
"""Largest commanded velocity, rad/s or m/s."""


def setpoint(
    robot: Robot, kind: str, center: np.ndarray, seconds: float, rng: np.random.Generator
) -> np.ndarray:
    """(milliseconds, joints) of one kind about a centre (joints,); velocities for their servos."""
    n = len(robot.joints)
    t = np.arange(0.0, seconds, FINE)[:, None]
    size = np.full(n, 0.25) if robot.joints[0].slide else rng.uniform(0.3, 0.7, n)
    start = 1.0 - np.exp(-((t / 0.5) ** 2))  # the motion begins at rest
    if kind == "multisine":
        tones, phases = rng.uniform(0.15, 1.6, (4, n)), rng.uniform(0.0, 2 * np.pi, (4, n))
        waves = np.sin(2 * np.pi * tones[:, None] * t + phases[:, None]) / (1 + tones[:, None])
        out = center + 0.8 * size * start * waves.sum(axis=0)
    elif kind == "moves":
        leg, takes = rng.uniform(1.0, 1.6), rng.uniform(0.4, 0.9)
        out = _between(robot, kind, center, size, t, leg, takes, rng)
    elif kind == "steps":
        # A velocity servo gets steps of velocity, which are ramps of position.
        takes = 1.0 if robot.mode == "velocity" else 0.0
        out = _between(robot, kind, center, 0.5 * size, t, rng.uniform(0.9, 1.3), takes, rng)
    elif kind == "slow":
        period = rng.uniform(2.5, 4.5, n)
        triangle = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * t / period))
        out = center + size * triangle * np.where(t < seconds / 2, 1.0, 0.3)
    else:
        top = rng.uniform(1.5, 2.5, n)
        out = center + 0.5 * size * start * np.sin(np.pi * top * t**2 / seconds) / (1 + t / seconds)
    if robot.mode == "velocity":
        out = np.clip(np.gradient(out, FINE, axis=0), -VELOCITY_BOUND, VELOCITY_BOUND)
    return out


def _between(
    robot: Robot, kind: str, center: np.ndarray, size: np.ndarray, t: np.ndarray, leg: float,
    takes: float, rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Return setpoints with new targets every ``leg`` s, reached in ``takes`` s."""
    legs = int(t[-1, 0] / leg) + 1
    targets = center + size * rng.uniform(-1.0, 1.0, (legs + 1, len(size)))
    targets[0] = center
    now = np.minimum((t[:, 0] / leg).astype(int), legs - 1)
    if takes == 0.0:
        return targets[now]
    part = np.clip((t - leg * now[:, None]) / takes, 0.0, 1.0)
    smooth = part if kind == "steps" else part**3 * (10 - 15 * part + 6 * part**2)
    return targets[now] + smooth * (targets[now + 1] - targets[now])


def setpoints(robot: Robot, seconds: float, rng: np.random.Generator) -> np.ndarray:
    """(milliseconds, recordings, joints) of the five recordings: three to fit, two held out."""
    n = len(robot.joints)
    kinds = [str(kind) for kind in rng.permutation(KINDS)]
    centers = [np.zeros(n) if robot.joints[0].slide else rng.uniform(-0.4, 0.4, n) for _ in kinds]
    each = [
        setpoint(robot, kind, center, seconds, rng)
        for kind, center in zip(kinds, centers, strict=True)
    ]
    return np.stack(each, axis=1)
