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
from pytest_twin.diagnosis.integrator_settings import FRICTION_CONSTRAINT
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import PreparedProblem
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
from pytest_twin.diagnosis.structure_search.score import SimulatedModel
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis

FRICTION_CREEP_NOTE = (
    "dry friction creeps under load in these recordings, as in MuJoCo's default friction "
    "constraint; with friction that holds at rest the residual is larger"
)


def build_problem_with_better_constraint(
    setup: ModelSetup, trials: TrialSet, notes: list[str]
) -> tuple[ModelSetup, PreparedProblem, TrialSet]:
    """The problem, with the friction constraint that explains the recordings better.

    The constraints are compared only if the nominal model is nearly right.

    Args:
        setup: the model with its simulation settings.
        notes: receives notes for the reader.

    Raises:
        SimulationError: as :func:`~pytest_twin.diagnosis.search_result.build_problem`.
    """
    prepared, kept = build_problem(setup, trials, notes)
    problem = prepared.problem
    if not has_dry_friction(problem, EMPTY):
        return setup, prepared, kept
    left = residuals_everywhere(problem, EMPTY)
    if not VERDICT.identifiable < _worst_joint_rms(problem, left) < VERDICT.left_floors:
        return setup, prepared, kept
    other = _residuals_with_other_constraint(problem, EMPTY)
    if _reduces_residual(problem, other, left, FRICTION_CONSTRAINT.left):
        setup = replace(setup, has_friction_creep=not setup.has_friction_creep)
        prepared, _ = build_problem(setup, kept, [])
    return setup, prepared, kept


def search_with_better_constraint(
    setup: ModelSetup,
    prepared: PreparedProblem,
    trials: TrialSet,
    run: Run,
    start: Hypothesis,
) -> tuple[ModelSetup, SearchResult]:
    """Search for effects, and change the friction constraint when the other one explains far more.

    The error of a wrong constraint is small. It becomes visible only when other effects are nearly
    explained, and a search would then add wrong effects at every joint.

    Args:
        setup: the model with its simulation settings.
        prepared, trials: its problem, and the trials.
        start: hypothesis from which the search starts.

    Returns:
        The simulation settings with the better constraint, and the result.
    """
    problem = prepared.problem
    changed_setup = replace(setup, has_friction_creep=not setup.has_friction_creep)
    other: tuple[PreparedProblem, TrialSet] | None = None

    def other_constraint_is_better(best: SimulatedModel) -> bool:
        nonlocal other
        left = np.concatenate([best.residual, best.validation])
        if (
            not has_dry_friction(problem, EMPTY)
            or _worst_joint_rms(problem, left) <= VERDICT.identifiable
        ):
            return False
        if other is None:
            other = build_problem(changed_setup, trials, [])
            run.budget.add(other[0].problem)
        residuals = residuals_everywhere(other[0].problem, best.hypothesis)
        return _reduces_residual(problem, residuals, left, FRICTION_CONSTRAINT.left)

    selection = EffectSelection(problem, run, should_stop=other_constraint_is_better)
    selected = selection.run(start)
    if other is None or not selection.was_stopped:
        return setup, conclude(prepared, trials, run, selected)
    # ``kept`` lacks trials on which the model diverges with the other constraint.
    changed, kept = other
    run.begin("whole recordings, other friction constraint", changed.problem)
    return changed_setup, search(
        changed, kept, EffectSelection(changed.problem, run), selected.best.hypothesis
    )


def refit_with_better_constraint(
    found: SearchResult, setup: ModelSetup, run: Run
) -> tuple[ModelSetup, SearchResult]:
    """Fit the findings with the other friction constraint; return the better result.

    Args:
        found: result with the friction constraint of ``setup``.
        setup: the model with its simulation settings.

    Returns:
        The simulation settings with the better constraint, and the result.
    """
    before, start = found.prepared.problem, found.explanation.hypothesis
    if (
        not has_dry_friction(before, start)
        or _worst_joint_rms(before, found.after) <= VERDICT.identifiable
    ):
        return setup, found
    if not _reduces_residual(
        before,
        _residuals_with_other_constraint(before, start),
        found.after,
        FRICTION_CONSTRAINT.left_unfitted,
    ):
        return setup, found
    changed_setup = replace(setup, has_friction_creep=not setup.has_friction_creep)
    prepared, trials = build_problem(changed_setup, found.trials, [])
    run.begin("whole recordings, other friction constraint", prepared.problem)
    selection = EffectSelection(prepared.problem, run)
    comparison = selection.comparison
    fitted = (
        comparison.fit_to_convergence(comparison.score_without_fit(start))
        if start.terms
        else comparison.nominal
    )
    residuals = residuals_everywhere(prepared.problem, fitted.hypothesis)
    if not _reduces_residual(before, residuals, found.after, FRICTION_CONSTRAINT.left):
        return setup, found
    return changed_setup, conclude(prepared, trials, run, selection.refine(fitted))


def has_dry_friction(problem: Problem, hypothesis: Hypothesis) -> bool:
    """Whether the model or the hypothesis contains dry friction."""
    layout, models = problem.simulator.layout, {s.model for s in problem.simulator.segments}
    own = any(m.dof_frictionloss[layout.dof_index].any() for m in models)
    return own or any(t.dry_level is not None for t in hypothesis.terms)


def with_other_constraint(problem: Problem) -> Problem:
    """The same problem with the other friction constraint; its discretization error is kept."""
    simulator = problem.simulator
    segments = [replace(s, has_friction_creep=not s.has_friction_creep) for s in simulator.segments]
    other = BatchSimulator(
        segments, problem.joints, threads=simulator.threads, refine=simulator.refine,
        fixed=simulator.fixed,
    )  # fmt: skip
    return problem.with_simulator(other, None)


def _residuals_with_other_constraint(problem: Problem, hypothesis: Hypothesis) -> FloatArray:
    """(samples, signals) residuals with the other friction constraint."""
    other = with_other_constraint(problem.at(hypothesis))
    return other.residuals([hypothesis], problem.all_segments)[0]


def _squares(problem: Problem, left: FloatArray) -> FloatArray:
    """(joints,) mean squared position residuals in squared noise floors."""
    return in_noise_floors(left[:, : len(problem.joints)], problem.floor) ** 2


def _worst_joint_rms(problem: Problem, left: FloatArray) -> float:
    """RMS position residual of the worst joint, in noise floors."""
    return float(np.sqrt(_squares(problem, left).max()))


def _reduces_residual(problem: Problem, left: FloatArray, than: FloatArray, share: float) -> bool:
    """Whether the squared residual above the noise floor is at most ``share`` of that of ``than``.

    Both are summed over joints.
    """
    new, old = (np.maximum(_squares(problem, x) - 1.0, 0.0).sum() for x in (left, than))
    return bool(new <= share * old)
