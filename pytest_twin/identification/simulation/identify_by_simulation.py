"""Identification by the simulation error of the closed loop: the search of a diagnosis.

The candidates of the search are the effects that have a stage. Its start are the basic effects of
all joints, from the equation error. What it finds is tested stage by stage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.budget import Budget
from pytest_twin.diagnosis.build_problem import residuals_everywhere
from pytest_twin.diagnosis.conclusion import evaluate_on_test, hypothesis_at_tested_joints
from pytest_twin.diagnosis.intervals import ParameterUncertainty, parameter_uncertainty
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search_result import joint_errors
from pytest_twin.diagnosis.searched_trials import search_trials
from pytest_twin.diagnosis.servo_priors import PriorUse, combine
from pytest_twin.diagnosis.signal_meaning import RecordedSignals
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel
from pytest_twin.identification.simulation.stage_effects import StagePlan
from pytest_twin.identification.simulation.stage_tests import StageTests, with_derivatives
from pytest_twin.identification.simulation.undetermined_terms import AbsentEffects
from pytest_twin.identification.stages import Stage, StageName, shares
from pytest_twin.realization import Realization
from pytest_twin.time_limit import current_limit, skips

_STEPS_OF_SEARCH = 0.9
"""Share of the progress that the search has."""


@dataclass(frozen=True)
class SimulationResult:
    """Result of an identification from commands and positions.

    Attributes:
        prepared: problem that was fitted.
        hypothesis: all effects, fitted together.
        stage_of: term -> its stage.
        spread: uncertainty of the final parameters.
        stages: stages in order.
        undetermined: term that may act unnoticed -> stage that fits it.
        errors: joint -> error on held-out recordings, or on fitted ones if none is held out.
        is_tested: whether recordings were held out.
        is_complete: whether the search ended by itself.
        signals: meaning of the recorded commands, velocities and efforts.
        trials: recordings as they were used.
        priors: what became of the priors of the servos.
        notes: one line each.
    """

    prepared: PreparedProblem
    hypothesis: Hypothesis
    stage_of: dict[Term, StageName]
    spread: ParameterUncertainty
    stages: tuple[Stage, ...]
    undetermined: dict[Term, StageName]
    errors: Mapping[str, JointError]
    is_tested: bool
    is_complete: bool
    signals: RecordedSignals
    trials: TrialSet
    priors: tuple[PriorUse, ...]
    notes: tuple[str, ...]


def identify_simulation(
    realization: Realization,
    trials: TrialSet,
    *,
    inherited: PatchedModel | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
    plan: StagePlan | None = None,
) -> SimulationResult:
    """Search effects among those of the stages, and test each stage on the held-out recordings.

    Args:
        trials: recordings with commands.
        inherited: effects of an earlier diagnosis that the MJCF does not contain.
        progress: called with the fraction done.
        plan: stages that are fitted, and their effects; by default all.

    Raises:
        RecordingError: the model and the recordings share no joint.
        SimulationError: the model diverges on every recording.
    """
    plan, limit = plan or StagePlan(), current_limit()
    run = Run(Budget(limit.seconds, np.inf, limit.clock, limit.begin))
    run.mask, run.first_values = plan.mask, plan.start
    searched = search_trials(
        realization, trials, run, inherited=inherited,
        progress=lambda fraction: progress(_STEPS_OF_SEARCH * fraction),
    )  # fmt: skip
    structure = searched.structure
    limit.left_out(run.skipped_searches)
    with np.errstate(over="ignore", invalid="ignore"):
        evaluated = evaluate_on_test(structure, searched.trials)
        found, tested = structure.found, evaluated.tested
        prepared, hypothesis = found.prepared, found.explanation.hypothesis
        problem, test_problem = prepared.problem, tested.prepared.problem
        column = {problem.joints.index(j): k for k, j in enumerate(test_problem.joints)}
        errors, spread = tested.errors, found.explanation.of_recordings
        tests = StageTests(
            plan, with_derivatives(problem, hypothesis), problem, test_problem,
            partial(hypothesis_at_tested_joints, column=column),
        )  # fmt: skip
        stages = tests.stages(errors)
        kept = tests.without_rejected(stages)
        if kept.terms != hypothesis.terms:
            hypothesis, spread = kept, None
            tests = replace(tests, fitted=with_derivatives(problem, hypothesis))
            errors = joint_errors(
                tested.prepared, tested.before,
                residuals_everywhere(test_problem, tests.at_tested_joints(hypothesis)),
            )  # fmt: skip
            stages = [*stages[:-1], tests.together(errors)]
        slopes = tests.fitted
        stage_of = {t: plan.stage_of[t.effect] for t in hypothesis.terms}
        if spread is None:
            spread = parameter_uncertainty(problem.at(hypothesis), slopes)
        undetermined, widened = dict[Term, StageName](), spread
        if not skips("which values of the model hold"):
            absent = AbsentEffects.of(problem, hypothesis, plan)
            undetermined, widened = absent.undetermined(), absent.widened(spread)
            stages = [_as_the_model_says(one, undetermined) for one in stages]
        combined = combine(problem.at(hypothesis), slopes, spread, widened)
        if combined.is_moved:
            hypothesis = combined.hypothesis
            errors = joint_errors(
                tested.prepared, tested.before,
                residuals_everywhere(test_problem, tests.at_tested_joints(hypothesis)),
            )  # fmt: skip
    stages = [_with_data(one, problem, slopes, stage_of, found.trials) for one in stages]
    used = replace(searched.trials, fit=found.trials.fit, held_out=tested.trials.held_out)
    return SimulationResult(
        prepared, hypothesis, stage_of, combined.uncertainty, tuple(stages), undetermined, errors,
        bool(len(test_problem.held_out)), not run.skipped_searches, searched.signals, used,
        combined.uses,
        (*searched.trials.notes, *structure.notes, *evaluated.notes),
    )  # fmt: skip


def _as_the_model_says(stage: Stage, undetermined: Mapping[Term, StageName]) -> Stage:
    """Return the stage with the reason if the motion shows that the model's values hold."""
    if stage.state != "not_observable" or stage.name in undetermined.values():
        return stage
    why = f"the model's values hold: the motion would show a difference, and {stage.why}"
    return replace(stage, why=why)


def _with_data(
    stage: Stage,
    problem: Problem,
    slopes: FittedModel,
    stage_of: Mapping[Term, StageName],
    trials: TrialSet,
) -> Stage:
    """Return the stage with each recording's share of the information on its parameters."""
    whole = stage.name == "closed_loop"
    others = [t for t in slopes.hypothesis.terms if not whole and stage_of[t] != stage.name]
    columns = slopes.hypothesis.parameters_without(*others)
    if stage.state not in ("accepted", "reopened") or not columns.any():
        return stage
    weights = 1.0 / np.maximum(slopes.mean_square, problem.signal_floor**2)
    rows: FloatArray = np.einsum("tsp,s->tp", slopes.jacobian[..., columns] ** 2, weights)
    each = np.split(rows, np.cumsum(problem.lengths(problem.fit))[:-1])
    names = [trials.fit[problem.simulator.segments[s].trial].path.name for s in problem.fit]
    return replace(stage, data=shares(names, np.array([own.sum(axis=0) for own in each])))
