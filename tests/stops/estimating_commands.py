"""Small inputs of every command that estimates, for tests that end it early."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path += [
    str(Path(__file__).parents[1] / room)
    for room in ("diagnosis", "identification", "ranges", "excitation", "budget")
]

import approved_arms
import budget_files
import ranges_files
import two_pendulums
from test_identify_simulation import MODEL, NOMINAL, write_trial


@dataclass(frozen=True)
class Estimating:
    """A command that estimates.

    Attributes:
        words: command line without ``--out``.
        result: main file of its folder.
        complete: verdict that only a complete run may have; empty for none.
    """

    words: tuple[str, ...]
    result: str
    complete: str


def diagnose(folder: Path) -> Estimating:
    words = two_pendulums.case(folder, joints=("left",), viscous=0.1)
    return Estimating(("diagnose", *words), "diagnosis.json", "")


def fleet(folder: Path) -> Estimating:
    for robot in ("one", "two", "three"):
        two_pendulums.case(folder / robot, joints=("left",), viscous=0.1)
    names = sorted(p.name for p in (folder / "one").glob("*.mcap"))
    robots = [
        f"  {robot}: {{model: {robot}/model.xml, "
        f"recordings: [{', '.join(f'{robot}/{name}' for name in names)}]}}\n"
        for robot in ("one", "two", "three")
    ]
    (folder / "fleet.yaml").write_text("robots:\n" + "".join(robots))
    words = ("diagnose", "--fleet", str(folder / "fleet.yaml"), "--jobs", "2")
    return Estimating(words, "fleet.json", "")


def identify(folder: Path) -> Estimating:
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    files = [str(write_trial(folder / f"{seed}.csv", seed)) for seed in (1, 2, 3)]
    words = ("identify", str(folder / "model.xml"), *files[:2], "--held-out", files[2])
    return Estimating((*words, "--command-between", "held"), "identification.json", "accepted")


def randomize(folder: Path) -> Estimating:
    twin = ranges_files.make_twin(folder, [ranges_files.record(ranges_files.covariance())])
    (folder / "recordings").mkdir()
    rng = np.random.default_rng(3)
    arm = ranges_files.true_arm(
        np.random.default_rng(1).multivariate_normal(ranges_files.MEANS, ranges_files.covariance())
    )
    for name in ("final_1", "final_2"):
        ranges_files.record_motion(folder / "recordings" / f"{name}.mcap", arm, rng, seconds=2.0)
    return Estimating(("randomize", str(twin)), "ranges.json", "")


def excite(folder: Path) -> Estimating:
    twin = approved_arms.write_twin(folder, approved_arms.approved_for_arm())
    return Estimating(("excite", str(twin)), "excitation.json", "identifiable")


def budget(folder: Path) -> Estimating:
    records = [
        budget_files.zeros_record([[1e-6]], (joint,), ident=joint)
        for joint in ("shoulder", "elbow")
    ]
    limits = "  tolerance: {position: 1.0, rotation: 1.0}\n"
    twin = budget_files.make_twin(folder, records, budget=budget_files.declared(more=limits))
    return Estimating(("budget", str(twin)), "budget.json", "within")


INPUTS: Mapping[str, Callable[[Path], Estimating]] = {
    "diagnose": diagnose, "fleet": fleet, "identify": identify, "randomize": randomize,
    "excite": excite, "budget": budget,
}  # fmt: skip
"""Name of a test -> its command, whose input is written to a folder."""
