"""Whether dry friction holds or creeps, by what the recordings say.

A joint at rest under its friction stays where it is. In MuJoCo's default constraint it creeps, and
so does what MuJoCo recorded: less than any effect has a name for, and above the floor where little
noise is. The recordings are asked, where dry friction is in the model or was found.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import Prepared
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.noise_levels import in_noise_floors
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    build_problem,
    conclude,
    from_start,
    residuals_everywhere,
    search,
)
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects.batch_simulator import BatchSimulator

CREEPS = (
    "dry friction creeps under load in these recordings, as in MuJoCo's default friction "
    "constraint; with friction that holds at rest the residual is larger"
)
# Greatest share of the residual above the noise floor with the other friction constraint if that is
# right: with fitted effects, and with the nominal model.
_LEFT, _UNFITTED = 0.5, 0.8


def build_problem_as_friction_acts(
    given: ModelSetup, trials: TrialSet, notes: list[str]
) -> tuple[ModelSetup, Prepared, TrialSet]:
    """The problem, with dry friction the way that leaves less where a model is nearly right as it
    came.

    Raises:
        SimulationError: as :func:`~pytest_twin.diagnosis.search_result.pose`.
    """
    prepared, kept = build_problem(given, trials, notes)
    problem = prepared.problem
    if not has_dry_friction(problem, EMPTY):
        return given, prepared, kept
    left = residuals_everywhere(problem, EMPTY)
    near = VERDICT.stands_out < _greatest(problem, left) < VERDICT.left_floors
    if near and _leaves_less(problem, _left_otherwise(problem, EMPTY), left):
        given = replace(given, creeps=not given.creeps)
        prepared, _ = build_problem(given, kept, [])
    return given, prepared, kept


def search_as_friction_acts(
    given: ModelSetup,
    prepared: Prepared,
    trials: TrialSet,
    run: Run,
    start: Hypothesis,
) -> tuple[ModelSetup, SearchResult]:
    """What a search finds, gone on with dry friction the other way once that leaves far less.

    Where the model has dry friction at every joint, what a simulation's does otherwise hides behind
    what was hidden, and stands out when that is nearly explained: a search that went on would
    gather names for it at every joint.

    Args:
        given: the model.
        prepared, trials: its problem.
        run: the diagnosis.
        start: what is known already.
    """
    problem = prepared.problem
    stepped = replace(given, creeps=not given.creeps)
    other: tuple[Prepared, TrialSet] | None = None

    def better_so(best: ScoredModel) -> bool:
        nonlocal other
        left = np.concatenate([best.fitted.residual, best.held_residual])
        if not has_dry_friction(problem, EMPTY) or _greatest(problem, left) <= VERDICT.stands_out:
            return False
        if other is None:
            other = build_problem(stepped, trials, [])
            run.budget.add(other[0].problem)
        return _leaves_less(problem, residuals_everywhere(other[0].problem, best.hypothesis), left)

    selection = StepwiseSelection(problem, run, leave=better_so)
    selected = from_start(selection, start)
    if other is None or not selection.left_off:
        return given, conclude(prepared, trials, selection, selected)
    # Trials on which the model diverges that way are left out of it.
    there, kept = other
    run.begin("whole recordings, dry friction that creeps otherwise", there.problem)
    return stepped, search(
        there, kept, StepwiseSelection(there.problem, run), selected.best.hypothesis
    )


def refit_as_friction_acts(
    found: SearchResult, given: ModelSetup, run: Run
) -> tuple[ModelSetup, SearchResult]:
    """What was found, fitted with dry friction the other way, where that leaves far less.

    Args:
        found: with dry friction as ``given``.
        given: the model.
        run: the diagnosis.
    """
    before, start = found.prepared.problem, found.explained.hypothesis
    if not has_dry_friction(before, start) or _greatest(before, found.after) <= VERDICT.stands_out:
        return given, found
    if not _leaves_less(before, _left_otherwise(before, start), found.after, _UNFITTED):
        return given, found
    stepped = replace(given, creeps=not given.creeps)
    prepared, trials = build_problem(stepped, found.trials, [])
    run.begin("whole recordings, dry friction that creeps otherwise", prepared.problem)
    selection = StepwiseSelection(prepared.problem, run)
    comparison = selection.comparison
    rival = (
        comparison.settled(comparison.scored_without_fit(start))
        if start.terms
        else comparison.nominal
    )
    if not _leaves_less(
        before, residuals_everywhere(prepared.problem, rival.hypothesis), found.after
    ):
        return given, found
    return stepped, conclude(prepared, trials, selection, selection.run(rival))


def has_dry_friction(problem: Problem, hypothesis: Hypothesis) -> bool:
    """Whether dry friction is in the model, or was found."""
    layout, models = problem.simulator.layout, {s.model for s in problem.simulator.segments}
    own = any(m.dof_frictionloss[layout.dof_index].any() for m in models)
    return own or any(t.dry_level is not None for t in hypothesis.terms)


def with_other_constraint(problem: Problem) -> Problem:
    """The same with dry friction the other way, the error of the step as it was measured."""
    stepped = problem.simulator
    segments = [replace(s, creeps=not s.creeps) for s in stepped.segments]
    other = BatchSimulator(
        segments, problem.joints, threads=stepped.threads, refine=stepped.refine,
        fixed=stepped.fixed,
    )  # fmt: skip
    return replace(problem, simulator=other, refined=None)


def _left_otherwise(problem: Problem, hypothesis: Hypothesis) -> FloatArray:
    """(samples, signals) residuals with dry friction the other way."""
    return with_other_constraint(problem).residuals([hypothesis], problem.everywhere)[0]


def _squares(problem: Problem, left: FloatArray) -> FloatArray:
    """(joints,) mean squares, in noise floors, of the positions of (samples, signals) residuals."""
    return in_noise_floors(left[:, : len(problem.joints)], problem.floor) ** 2


def _greatest(problem: Problem, left: FloatArray) -> float:
    """Root mean square, in noise floors, at the joint that shows most."""
    return float(np.sqrt(_squares(problem, left).max()))


def _leaves_less(
    problem: Problem, left: FloatArray, than: FloatArray, share: float = _LEFT
) -> bool:
    """Whether the residual above the noise floor is this small, summed over joints."""
    here, there = (np.maximum(_squares(problem, x) - 1.0, 0.0).sum() for x in (left, than))
    return bool(here <= share * there)
