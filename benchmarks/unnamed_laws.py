"""Share of the held-out error that unnamed laws remove, for forces outside of the catalogue.

    python benchmarks/unnamed_laws.py --out DIR [--seeds 71100:71120]

Each seed hides one force (``kernel.OUTSIDE_KINDS``, in turn). The search over named effects is
skipped: the law is fitted to windows of the fit recordings with the nominal model, and predicts
whole held-out recordings. The script prints a row for each case, and for each kind the number of
cases in which at least half of the squared error is removed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "concealed"))

from cases import OUTSIDE_NAMES, make, seeds

from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.locate import TimeAndRegime
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.diagnosis.unnamed_law.fit import fit_free_laws
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.realization import load

TOPICS = {"state": "/joint_states", "command": "/joint_commands"}


def removed(folder: Path, joint: str) -> tuple[float, str]:
    """Return the removed share of a joint's squared held-out error, and a text."""
    realization = load(folder / "model.xml")
    recordings = sorted((folder / "recordings").glob("*.mcap"))
    trials = read_trials(recordings, [], TOPICS, realization.structure)
    setup = ModelSetup.of(realization, None)
    with np.errstate(over="ignore", invalid="ignore"):
        near, _ = build_problem(setup, trials, [], window=0.5)
        laws = fit_free_laws(near, EMPTY, {joint: TimeAndRegime("", {})}, near.problem.fit)
        if not laws.laws:
            return 0.0, "; ".join(laws.notes)
        problem = build_problem(setup, trials, [])[0].problem
        residuals = problem.errors([EMPTY, laws.hypothesis], problem.held_out)
    before, after = (float(np.sum(r[:, problem.joints.index(joint)] ** 2)) for r in residuals)
    return 1.0 - after / before, "; ".join(law.words for law in laws.laws)


def main() -> None:
    """Write the cases, and fit a law to each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=seeds, default=seeds("71100:71120"))
    args = parser.parse_args()
    shares: dict[str, list[float]] = defaultdict(list)
    for k, seed in enumerate(args.seeds):
        kind = OUTSIDE_NAMES[k % len(OUTSIDE_NAMES)]
        cases, truth = args.out / "cases", args.out / "truth"
        name = make(seed, cases, truth, kind)
        outside = json.loads((truth / f"{name}.json").read_text())["outside"]
        share, words = removed(cases / name, outside["joint"])
        shares[kind].append(share)
        print(f"{name} {kind} {100 * share:.1f} % removed: {words}", flush=True)
    for kind, of_kind in shares.items():
        half = sum(share >= 0.5 for share in of_kind)
        print(f"{kind}: {half} of {len(of_kind)} lose half of their squared held-out error or more")


if __name__ == "__main__":
    main()
