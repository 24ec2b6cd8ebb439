"""Detection of creep under dry friction from the recordings.

A real joint at rest under its friction does not move. With MuJoCo's default friction constraint it
creeps, and so it does in recordings that MuJoCo made. The creep is smaller than any effect of the
catalogue, but larger than the noise of such recordings. Both friction constraints are compared if
the model or the findings contain dry friction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis
from pytest_twin.diagnosis.integrator_settings import FRICTION_CONSTRAINT
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import Prepared
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.noise_levels import in_noise_floors
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    build_problem,
    conclude,
    residuals_everywhere,
    search,
)
from pytest_twin.diagnosis.structure_search.score import Model
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects.batch_simulator import BatchSimulator

CREEPS = (
    "dry friction creeps under load in these recordings, as in MuJoCo's default friction "
    "constraint; with friction that holds at rest the residual is larger"
)


def build_problem_as_friction_acts(
    given: ModelSetup, trials: TrialSet, notes: list[str]
) -> tuple[ModelSetup, Prepared, TrialSet]:
    """The problem, with the friction constraint that explains the recordings better.

    The constraints are compared only if the nominal model is nearly right.

    Args:
        given: the model with its simulation settings.
        trials: the recordings.
        notes: receives notes for the reader.

    Raises:
        SimulationError: as :func:`~pytest_twin.diagnosis.search_result.build_problem`.
    """
    prepared, kept = build_problem(given, trials, notes)
    problem = prepared.problem
    if not has_dry_friction(problem, EMPTY):
        return given, prepared, kept
    left = residuals_everywhere(problem, EMPTY)
    if not VERDICT.identifiable < _greatest(problem, left) < VERDICT.left_floors:
        return given, prepared, kept
    other = _residuals_with_other_constraint(problem, EMPTY)
    if _leaves_less(problem, other, left, FRICTION_CONSTRAINT.left):
        given = replace(given, has_friction_creep=not given.has_friction_creep)
        prepared, _ = build_problem(given, kept, [])
    return given, prepared, kept


def search_as_friction_acts(
    given: ModelSetup,
    prepared: Prepared,
    trials: TrialSet,
    run: Run,
    start: Hypothesis,
) -> tuple[ModelSetup, SearchResult]:
    """Search for effects, and change the friction constraint when the other one explains far more.

    The error of a wrong constraint is small. It becomes visible only when other effects are nearly
    explained, and a search would then add wrong effects at every joint.

    Args:
        given: the model with its simulation settings.
        prepared, trials: its problem, and the trials.
        run: the running diagnosis.
        start: hypothesis from which the search starts.

    Returns:
        The simulation settings with the better constraint, and the result.
    """
    problem = prepared.problem
    stepped = replace(given, has_friction_creep=not given.has_friction_creep)
    other: tuple[Prepared, TrialSet] | None = None

    def other_constraint_is_better(best: Model) -> bool:
        nonlocal other
        left = np.concatenate([best.residual, best.validation])
        if not has_dry_friction(problem, EMPTY) or _greatest(problem, left) <= VERDICT.identifiable:
            return False
        if other is None:
            other = build_problem(stepped, trials, [])
            run.budget.add(other[0].problem)
        rest = residuals_everywhere(other[0].problem, best.hypothesis)
        return _leaves_less(problem, rest, left, FRICTION_CONSTRAINT.left)

    selection = EffectSelection(problem, run, leave=other_constraint_is_better)
    selected = selection.run(start)
    if other is None or not selection.has_left:
        return given, conclude(prepared, trials, run, selected)
    # ``kept`` lacks trials on which the model diverges with the other constraint.
    changed, kept = other
    run.begin("whole recordings, other friction constraint", changed.problem)
    return stepped, search(
        changed, kept, EffectSelection(changed.problem, run), selected.best.hypothesis
    )


def refit_as_friction_acts(
    found: SearchResult, given: ModelSetup, run: Run
) -> tuple[ModelSetup, SearchResult]:
    """Fit the findings with the other friction constraint; return the better result.

    Args:
        found: result with the friction constraint of ``given``.
        given: the model with its simulation settings.
        run: the running diagnosis.

    Returns:
        The simulation settings with the better constraint, and the result.
    """
    before, start = found.prepared.problem, found.explained.hypothesis
    if (
        not has_dry_friction(before, start)
        or _greatest(before, found.after) <= VERDICT.identifiable
    ):
        return given, found
    if not _leaves_less(
        before,
        _residuals_with_other_constraint(before, start),
        found.after,
        FRICTION_CONSTRAINT.left_unfitted,
    ):
        return given, found
    stepped = replace(given, has_friction_creep=not given.has_friction_creep)
    prepared, trials = build_problem(stepped, found.trials, [])
    run.begin("whole recordings, other friction constraint", prepared.problem)
    selection = EffectSelection(prepared.problem, run)
    comparison = selection.comparison
    rival = (
        comparison.fit_to_convergence(comparison.score_without_fit(start))
        if start.terms
        else comparison.nominal
    )
    rest = residuals_everywhere(prepared.problem, rival.hypothesis)
    if not _leaves_less(before, rest, found.after, FRICTION_CONSTRAINT.left):
        return given, found
    return stepped, conclude(prepared, trials, run, selection.refine(rival))


def has_dry_friction(problem: Problem, hypothesis: Hypothesis) -> bool:
    """Whether the model or the hypothesis contains dry friction."""
    layout, models = problem.simulator.layout, {s.model for s in problem.simulator.segments}
    own = any(m.dof_frictionloss[layout.dof_index].any() for m in models)
    return own or any(t.dry_level is not None for t in hypothesis.terms)


def with_other_constraint(problem: Problem) -> Problem:
    """The same problem with the other friction constraint; its discretization error is kept."""
    stepped = problem.simulator
    segments = [replace(s, has_friction_creep=not s.has_friction_creep) for s in stepped.segments]
    other = BatchSimulator(
        segments, problem.joints, threads=stepped.threads, refine=stepped.refine,
        fixed=stepped.fixed,
    )  # fmt: skip
    return problem.with_simulator(other, None)


def _residuals_with_other_constraint(problem: Problem, hypothesis: Hypothesis) -> FloatArray:
    """(samples, signals) residuals with the other friction constraint."""
    other = with_other_constraint(problem.at(hypothesis))
    return other.residuals([hypothesis], problem.everywhere)[0]


def _squares(problem: Problem, left: FloatArray) -> FloatArray:
    """(joints,) mean squared position residuals in squared noise floors."""
    return in_noise_floors(left[:, : len(problem.joints)], problem.floor) ** 2


def _greatest(problem: Problem, left: FloatArray) -> float:
    """RMS position residual of the worst joint, in noise floors."""
    return float(np.sqrt(_squares(problem, left).max()))


def _leaves_less(problem: Problem, left: FloatArray, than: FloatArray, share: float) -> bool:
    """Whether the squared residual above the noise floor is at most ``share`` of that of ``than``.

    Both are summed over joints.
    """
    new, old = (np.maximum(_squares(problem, x) - 1.0, 0.0).sum() for x in (left, than))
    return bool(new <= share * old)
