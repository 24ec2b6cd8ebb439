"""The machine of the tutorial "A machine wears": run a motion on it, and record it.

Run ``python machine.py MOTION.csv OUT.csv [--dry-friction N] [--day N]``. The plant is this file's
own: a mass, a position servo, viscous and Coulomb friction, at 20 kHz. Friction differs by 2 % from
day to day. Units: m, kg, s, N.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

MASS, STIFFNESS, DAMPING, LARGEST_FORCE = 12.0, 4000.0, 400.0, 400.0
VISCOUS, COULOMB = 85.0, 14.0
STEP, SAMPLE = 5e-5, 0.01
NOISE, FORCE_NOISE = 5e-6, 0.5


def run(commands: np.ndarray, viscous: float, coulomb: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and force of the servo at each sample, under commands held for one sample."""
    position, velocity = float(commands[0]), 0.0
    positions, forces = np.empty_like(commands), np.empty_like(commands)
    for sample, command in enumerate(commands):
        for step in range(round(SAMPLE / STEP)):
            drive = STIFFNESS * (command - position) - DAMPING * velocity
            drive = min(max(drive, -LARGEST_FORCE), LARGEST_FORCE)
            if step == 0:
                positions[sample], forces[sample] = position, drive
            free = velocity + STEP * (drive - viscous * velocity) / MASS
            # Coulomb friction stops the carriage with at most its own impulse (Moreau 1988).
            stop = STEP * coulomb / MASS
            velocity = free - min(max(free, -stop), stop)
            position += STEP * velocity
    return positions, forces


def main() -> None:
    """Run one motion and write what a logger records."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "motion", type=Path, help="CSV file with the columns time and slide.command"
    )
    parser.add_argument("out", type=Path, help="CSV file of the recording")
    parser.add_argument("--dry-friction", type=float, default=COULOMB, help="N")
    parser.add_argument("--day", type=int, default=1)
    args = parser.parse_args()
    with args.motion.open(newline="") as file:
        commands = np.array([float(row["slide.command"]) for row in csv.DictReader(file)])
    random = np.random.default_rng(args.day)
    warm = 1.0 + 0.02 * random.standard_normal(2)
    position, force = run(commands, VISCOUS * warm[0], args.dry_friction * warm[1])
    position = position + NOISE * random.standard_normal(len(commands))
    force = force + FORCE_NOISE * random.standard_normal(len(commands))
    with args.out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time", "slide.position", "slide.effort", "slide.command"])
        for k, row in enumerate(zip(position, force, commands, strict=True)):
            writer.writerow([f"{SAMPLE * k:.2f}", *(f"{value:.6f}" for value in row)])


if __name__ == "__main__":
    main()
