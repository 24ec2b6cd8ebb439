"""Compare the present search and the structure search on the same cases.

    python benchmarks/two_searches.py CASE... [--search present structure]

CASE is a folder with ``model.xml`` or ``twin.yaml`` and ``recordings/*.mcap``, as
``benchmarks/concealed/cases.py`` writes it. For each search, the chosen effects, the number of
simulations of all data, the processor time, and the residual in noise floors are printed. The
results are not pruned, and no test recording is used.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from pytest_twin.commands.replay import load_model
from pytest_twin.diagnosis.friction_constraint import build_problem_as_friction_acts
from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.roles import roles_of
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
from pytest_twin.diagnosis.structure_search.search import StructureSearch
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.realization.files.search import SearchFolders
from pytest_twin.realization.quiet import quiet

SEARCHES = ("present", "structure")


def problem_of(case: Path) -> Problem:
    """Build the problem of a case without its test recordings."""
    model = case / "twin.yaml" if (case / "twin.yaml").exists() else case / "model.xml"
    loaded = load_model(model, SearchFolders.of((), None))
    recordings = sorted((case / "recordings").glob("*.mcap"))
    read = read_trials(recordings, [], loaded.topics, loaded.realization.structure)
    _, prepared, _ = build_problem_as_friction_acts(
        ModelSetup.of(loaded.realization, None, 1), roles_of(read).of_search, []
    )
    return prepared.problem


def chosen_by(search: str, problem: Problem) -> Hypothesis:
    """Return the effects that a search chooses, with their parameters."""
    if search == "present":
        return StepwiseSelection(problem).run().best.hypothesis
    return StructureSearch(problem).run().model.hypothesis


def in_words(problem: Problem, hypothesis: Hypothesis) -> str:
    """Format effects with their joints and values, SI units."""
    lines = []
    for term in hypothesis.terms:
        joint = "" if term.joint < 0 else f" at {problem.joints[term.joint]}"
        values = hypothesis.theta[hypothesis.slice_of(term)]
        numbers = ", ".join(
            f"{p.reported_name} {p.reported(float(v) * problem.scales.value(p, term.joint)):.4g}"
            for p, v in zip(term.parameters, values, strict=True)
        )
        lines.append(f"    {term.effect}{joint}: {numbers}")
    return "\n".join(lines) or "    no effect"


def main() -> None:
    """Run each search on every case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", type=Path, nargs="+")
    parser.add_argument("--search", choices=SEARCHES, nargs="+", default=SEARCHES)
    args = parser.parse_args()
    for case in args.cases:
        for search in args.search:
            with quiet(), np.errstate(over="ignore", invalid="ignore"):
                problem = problem_of(case)
                before, since = problem.stepped, time.process_time()
                chosen = chosen_by(search, problem)
                seconds = time.process_time() - since
                simulations = (problem.stepped - before) / problem.simulator.steps.sum()
                problem.refine_at(chosen)
                (residual,) = problem.residuals([chosen], problem.everywhere)
            floors = np.sqrt(np.mean(residual**2, axis=0)) / problem.signal_floor
            print(
                f"{case.name}, {search} search: {simulations:.0f} simulations, {seconds:.0f} s, "
                f"residual {np.array2string(floors, precision=2)} noise floors"
            )
            print(in_words(problem, chosen))


if __name__ == "__main__":
    main()
