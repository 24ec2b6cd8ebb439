"""Baxter: how much do earlier recordings help, if the joint is known and 16 laws compete?

    TWIN_RECORDINGS=FOLDER python benchmarks/changes/known_joint.py [--choices N]

A simpler experiment than ``baxter.py``: every law is fitted by ridge to the earlier recordings and
subtracted from the three new ones; the law with the largest gain for each amplitude is named. The
last row has all eight recordings as earlier ones, so the new ones without the law are among them.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from baxter import read, write_recordings
from injected import IDENTIFIED, NEW, SIZES, Robot, drawn_amplitudes

from pytest_twin.changes.background import Contrast
from pytest_twin.changes.evidence import evidence_of
from pytest_twin.changes.prepared import prepare
from pytest_twin.identification.effort.law_columns import Shape

LAWS = (
    "armature", "asymmetric_friction", "cogging", "coulomb_friction",
    "directional_viscous_friction", "effort_bias", "effort_scale", "encoder_bias",
    "gear_efficiency", "joint_spring", "load_dependent_friction", "position_dependent_friction",
    "quadratic_drag", "stribeck_friction", "thermal_friction", "viscous_friction",
)  # fmt: skip
RIDGE, SINGULAR = 0.01, 1e-9
"""Relative to the mean of the diagonal; between 1e-3 and 0.1 the shares change by 3 points."""
FURTHER = 0.1
"""Penalty on the gain for each further amplitude."""
ROWS = {
    "none": ("none", "none"),
    "the other five, 16 laws": ("others", "laws"),
    "the other five, all laws": ("others", "all"),
    "all eight, 16 laws": ("all", "laws"),
}
COMMAND = "the command's comparison"


def solved(matrix: np.ndarray, vector: np.ndarray, ridge: float) -> np.ndarray:
    """Least squares with a ridge."""
    return np.linalg.solve(matrix + ridge * np.mean(np.diag(matrix)) * np.eye(len(vector)), vector)


def sums_of(robot: Robot, which: Sequence[int], joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Products of the columns of a joint, and with its effort."""
    parts = [robot.rows.sums[i][joint] for i in which]
    return sum(part.matrix for part in parts), sum(part.vector for part in parts)


def named(robot: Robot, shapes: Sequence[Shape], joint: int, new: Sequence[int],
          amplitudes: np.ndarray, row: tuple[str, str]) -> str:  # fmt: skip
    """Law with the largest gain."""
    columns = robot.rows.sums[0][joint].columns
    others = [i for i in range(robot.count) if i not in new]
    matrix, vector = sums_of(robot, new, joint)
    rest = vector + matrix @ amplitudes[columns]
    # A robot is identified before anything is compared.
    whole, of_whole = sums_of(robot, range(robot.count), joint)
    identified = np.isin(columns, identified_columns(robot))
    base = np.zeros(len(columns))
    base[identified] = solved(whole[np.ix_(identified, identified)], of_whole[identified], 1e-6)
    rest = rest - matrix @ base
    earlier, laws = row
    if earlier != "none":
        old, of_old = sums_of(robot, others if earlier == "others" else range(robot.count), joint)
        own = np.concatenate([shape.indices for shape in shapes])
        use = np.isin(columns, own) if laws == "laws" else np.ones(len(columns), dtype=bool)
        background = solved(old[np.ix_(use, use)], (of_old - old @ base)[use], RIDGE)
        rest = rest - matrix[:, use] @ background
    gains = []
    for shape in shapes:
        at = np.searchsorted(columns, shape.indices[np.isin(shape.indices, columns)])
        gain = rest[at] @ solved(matrix[np.ix_(at, at)], rest[at], SINGULAR)
        gains.append(gain / (1.0 + FURTHER * (len(at) - 1)))
    return shapes[int(np.argmax(gains))].term.effect


def identified_columns(robot: Robot) -> np.ndarray:
    """Columns of an identification."""
    return np.concatenate([s.indices for s in robot.shapes if s.term.effect in IDENTIFIED])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--choices", type=int, default=6, help="choices of the new recordings")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        robot = read(write_recordings(Path(scratch)))
    every = list(itertools.combinations(range(robot.count), NEW))
    order = np.random.default_rng(args.seed).permutation(len(every))[: args.choices]
    right: dict[tuple[str, float], list[bool]] = {}
    for new in [every[k] for k in order]:
        random = np.random.default_rng([args.seed, *new])
        earlier = [[i] for i in range(robot.count) if i not in new]
        prepared = prepare(robot.rows, earlier, [[i] for i in new], robot.shapes)
        contrast = prepared.contrasts(prepared.usual)[1]
        for joint, law in itertools.product(range(len(robot.laws.joints)), LAWS):
            own = [s for s in robot.shapes if s.term.joint == joint and s.term.effect in LAWS]
            drawn = [shape for shape in own if shape.term.effect == law]
            if not drawn:
                continue
            sample = drawn_amplitudes(robot, drawn, joint, new, random)
            for r in SIZES:
                for name, row in ROWS.items():
                    answer = named(robot, own, joint, new, r * sample, row)
                    right.setdefault((name, r), []).append(answer == law)
                changed = Contrast(
                    contrast.information, contrast.vector + contrast.information @ (r * sample)
                )
                evidence = evidence_of(changed, own, prepared.tempering.inflation)
                best = own[int(evidence.argmax())].term.effect
                right.setdefault((COMMAND, r), []).append(best == law)
    for name in (*ROWS, COMMAND):
        shares = [f"r = {r:g}: {100 * np.mean(right[name, r]):.0f} %" for r in SIZES]
        print(f"{name:<26} {', '.join(shares)} ({len(right[name, SIZES[0]])} cases)")


if __name__ == "__main__":
    main()
