"""Simulate recordings of a carriage on a rail, which has friction that ``axis.xml`` lacks.

Run ``python examples/carriage/record.py``; it writes ``recordings/*.csv``. The plant is this file's
own: a mass, a position servo, viscous friction and Coulomb friction, at 20 kHz. It shares no code
with pytest-twin and MuJoCo. Units: m, kg, s, N.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent / "recordings"
MASS, STIFFNESS, DAMPING, LARGEST_FORCE = 12.0, 4000.0, 400.0, 400.0
# Friction of the rail: N*s/m and N.
VISCOUS, COULOMB = 85.0, 14.0
STEP, SAMPLE, DURATION = 5e-5, 0.01, 6.0
NOISE, ENCODER_COUNT = 5e-6, 1e-6


def positions(commands: np.ndarray) -> np.ndarray:
    """Position at each sample under commands that are held for one sample."""
    position, velocity = float(commands[0]), 0.0
    measured = np.empty_like(commands)
    for sample, command in enumerate(commands):
        measured[sample] = position
        for _ in range(round(SAMPLE / STEP)):
            drive = STIFFNESS * (command - position) - DAMPING * velocity
            drive = min(max(drive, -LARGEST_FORCE), LARGEST_FORCE)
            free = velocity + STEP * (drive - VISCOUS * velocity) / MASS
            # Coulomb friction stops the carriage with at most its own impulse (Moreau 1988).
            stop = STEP * COULOMB / MASS
            velocity = free - min(max(free, -stop), stop)
            position += STEP * velocity
    return measured


def write(name: str, seed: int, command_at: Callable[[np.ndarray], np.ndarray]) -> None:
    """Simulate one recording and write it as a logger would."""
    time = np.arange(0.0, DURATION, SAMPLE)
    commands = command_at(time)
    noise = np.random.default_rng(seed).normal(0.0, NOISE, time.size)
    measured = np.round((positions(commands) + noise) / ENCODER_COUNT) * ENCODER_COUNT
    FOLDER.mkdir(exist_ok=True)
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time", "slide.position", "slide.command"])
        for row in zip(time, measured, commands, strict=True):
            writer.writerow([f"{row[0]:.2f}", f"{row[1]:.6f}", f"{row[2]:.6f}"])


def moves(time: np.ndarray) -> np.ndarray:
    """Smooth moves between stations, with a rest at each."""
    stations = np.array([0.0, 0.25, 0.1, -0.2, -0.15, 0.2, 0.0])
    move = np.minimum((time / 0.95).astype(int), len(stations) - 2)
    phase = np.clip((time - 0.95 * move) / 0.7, 0.0, 1.0)
    return stations[move] + phase**2 * (3 - 2 * phase) * (stations[move + 1] - stations[move])


def main() -> None:
    """Write two recordings to fit and one to hold out."""
    write("sweep", 1, lambda t: 0.2 * np.minimum(t, 1) * np.sin(2 * np.pi * (0.2 + 0.1 * t) * t))
    write("steps", 2, lambda t: 0.08 * np.sign(np.sin(2 * np.pi * 0.45 * t)) * (t > 0.5))
    write("moves", 3, moves)


if __name__ == "__main__":
    main()
