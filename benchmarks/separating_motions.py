"""Cases decided along the motions of ``excite --separate``, and along the usual motion.

    python benchmarks/separating_motions.py [--pairs 10] [--draws 20]

A planar arm with measured efforts (``tests/excitation/approved_arms.py``). A case is a pair of laws
at one joint, one of them true at its typical size, and a draw of noise at a multiple of the stated
noise. Both laws are fitted to the efforts. A case is decided if the true one has a probability of
at least 0.9. The usual motion is the D-optimal Fourier series that ``excite`` designs without
hypotheses, of the same length.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "excitation"))

from approved_arms import ARM, approved_for_arm, write_twin

from pytest_twin.estimation.comparison import Comparison, Size
from pytest_twin.estimation.score import NOISE_FLOORS
from pytest_twin.excitation.approved_robot import ApprovedRobot
from pytest_twin.excitation.candidates import whole_robot_candidates
from pytest_twin.excitation.discrimination import Imitation
from pytest_twin.excitation.hypotheses import read_rivals
from pytest_twin.excitation.separate import DECIDED, separate
from pytest_twin.excitation.separators import separator_of

LAWS = (
    "coulomb_friction", "viscous_friction", "stribeck_friction", "presliding_hysteresis",
    "joint_spring", "cogging", "armature", "quadratic_drag",
)  # fmt: skip
JOINTS = ("lift", "elbow")
NOISE = (1.0, 5.0, 20.0)
"""Noise of the draws, in multiples of the stated one."""


def robot_of(folder: Path, duration: float) -> ApprovedRobot:
    """The planar arm without servos."""
    model = ARM.split("<actuator>")[0] + "</mujoco>"
    return ApprovedRobot.load(write_twin(folder, approved_for_arm(duration=duration), model), 1)


def decided(robot: ApprovedRobot, words: str, draws: int) -> Iterator[tuple[float, int, int]]:
    """Noise, and numbers of decided cases along the usual and the separating motion."""
    rivals = read_rivals(words, robot.approved.names, None, None)
    separator = separator_of(robot, rivals, None)
    moved = sorted({rival.term.joint for rival in rivals})
    chosen = separate(robot, separator, moved)
    usual = next(
        one.design.motion(1.0, one.design.seed)
        for one in whole_robot_candidates(robot) if one.design.kind == "fourier"
    )  # fmt: skip
    for noise in NOISE:
        counts = [
            sum(_cases(separator.separations([motion])[0].imitations, noise, draws))
            for motion in (usual, *(safe.motion for safe, _ in chosen.motions[:1]))
        ]
        yield noise, counts[0], counts[1] if len(counts) > 1 else 0


def _cases(imitations: tuple[Imitation, Imitation], noise: float, draws: int) -> Iterator[bool]:
    """Whether each case is decided for its truth; the same draws for every motion."""
    random = np.random.default_rng(0)
    for one in imitations:
        signals = one.difference.shape[1]
        comparison = Comparison.of(one.effect, np.ones(signals), [len(one.effect)], [0], 2)
        truth, rival = Size(1, one.truth.free_count), Size(1, one.rival.free_count)
        for _ in range(draws):
            drawn = noise * random.standard_normal(one.difference.shape)
            left = (drawn**2).mean(axis=0), ((drawn + one.difference) ** 2).mean(axis=0)
            with_truth, with_rival = (
                comparison.log_likelihood(ms, NOISE_FLOORS) - comparison.penalty(size)
                for ms, size in zip(left, (truth, rival), strict=True)
            )
            yield bool(with_truth - with_rival >= np.log(DECIDED / (1.0 - DECIDED)))


def run(pairs: int, draws: int, duration: float = 8.0) -> dict[float, tuple[int, int, int]]:
    """Noise -> cases, and those decided along the usual and the separating motion."""
    every = [
        f"{a}@{joint},{b}@{joint}" for joint in JOINTS for a, b in combinations(LAWS, 2)
    ]  # fmt: skip
    some = np.random.default_rng(1).permutation(len(every))[:pairs]
    counts = dict.fromkeys(NOISE, (0, 0, 0))
    with tempfile.TemporaryDirectory() as folder:
        robot = robot_of(Path(folder), duration)
        for at in some:
            for noise, usual, separating in decided(robot, every[at], draws):
                cases, before, after = counts[noise]
                counts[noise] = cases + 2 * draws, before + usual, after + separating
    return counts


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--draws", type=int, default=20)
    args = parser.parse_args()
    for noise, (cases, usual, separating) in run(args.pairs, args.draws).items():
        print(f"noise {noise:g} times the stated one, {cases} cases: decided along the usual "
              f"motion {usual}, along that of --separate {separating}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
