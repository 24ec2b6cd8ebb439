"""Simulated reality: recordings of a pendulum with commands, positions and measured efforts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np

SAMPLE = 0.02
"""Period of the log, s."""


@dataclass(frozen=True)
class Plant:
    """A robot with the joint ``swing`` and one drive.

    Attributes:
        mjcf: MJCF of the robot.
        actuate: sets the drive's control from the command, in rad, before each step.
        interval: time step of the simulation, s.
        encoder_bias: of the measured position, rad.
    """

    mjcf: str
    actuate: Callable[[mujoco.MjData, float], None]
    interval: float
    encoder_bias: float = 0.0


@dataclass(frozen=True)
class Motion:
    """Commands between which the controller interpolates: a sum of four sines that begins at 0.

    Attributes:
        seconds: duration, s.
        amplitude: of one sine, rad.
        highest: highest frequency, Hz.
    """

    seconds: float
    amplitude: float
    highest: float

    def commands(self, random: np.random.Generator) -> np.ndarray:
        """(n,) commands at each sample, rad."""
        frequency = random.uniform(0.2, self.highest, 4)
        phase = random.uniform(0, 2 * np.pi, 4)
        time = np.arange(round(self.seconds / SAMPLE) + 1) * SAMPLE
        turned = 2 * np.pi * frequency * time[:, None] + phase
        found: np.ndarray = self.amplitude * (np.sin(turned) - np.sin(phase)).sum(axis=1)
        return found


def write_run(
    path: Path, seed: int, plant: Plant, motion: Motion, noise: tuple[float, float]
) -> Path:
    """Write positions, delivered efforts and commands at 50 Hz.

    Args:
        noise: standard deviations of a measured position, rad, and of a measured effort, N*m.
    """
    model = mujoco.MjModel.from_xml_string(plant.mjcf)
    model.opt.timestep = plant.interval
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    steps = round(SAMPLE / plant.interval)
    rows = []
    for at, (now, after) in enumerate(pairwise(motion.commands(random))):
        for step in range(steps):
            plant.actuate(data, now + (after - now) * step / steps)
            if not step:
                mujoco.mj_forward(model, data)
                position, effort = noise * random.standard_normal(2)
                position += data.qpos[0] + plant.encoder_bias
                rows.append((at * SAMPLE, position, data.actuator_force[0] + effort, now))
            mujoco.mj_step(model, data)
    head = "time,swing.position,swing.effort,swing.command"
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=head, comments="")
    return path
