"""Staged identification by the simulation error of the closed loop.

Each stage is a fit of the diagnosis with a given list of effects; nothing is searched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.intervals import ParameterUncertainty, parameter_uncertainty
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search_result import joint_errors
from pytest_twin.diagnosis.signal_meaning import RecordedSignals, determine_signals
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.estimation.deadline import OutOfTime, ending_at_limit
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel
from pytest_twin.identification.simulation.equation_error import first_values
from pytest_twin.identification.simulation.stage_effects import (
    StagePlan,
    nuisance_of,
    start,
    terms_of,
)
from pytest_twin.identification.simulation.stage_fit import with_derivatives
from pytest_twin.identification.simulation.staged_fit import StagedFit
from pytest_twin.identification.simulation.undetermined_terms import undetermined_terms
from pytest_twin.identification.stages import Stage, StageName, shares
from pytest_twin.realization import Realization
from pytest_twin.time_limit import skips

_KNOWN = "known"
"""Command mode that no effect acts on, of a joint whose drive is not fitted."""


@dataclass(frozen=True)
class SimulationResult:
    """Result of an identification from commands and positions.

    Attributes:
        prepared: estimation problem at the final parameters.
        hypothesis: all accepted terms, fitted together.
        stage_of: term -> stage that accepted it.
        spread: uncertainty of the final parameters.
        stages: stages in order.
        undetermined: term that may act unnoticed -> stage that fits it.
        errors: joint -> error on held-out recordings, or on fitted ones if none is held out.
        signals: meaning of the recorded commands, velocities and efforts.
        trials: recordings as they were used.
        notes: one line each.
    """

    prepared: PreparedProblem
    hypothesis: Hypothesis
    stage_of: dict[Term, StageName]
    spread: ParameterUncertainty
    stages: tuple[Stage, ...]
    undetermined: dict[Term, StageName]
    errors: dict[str, JointError]
    signals: RecordedSignals
    trials: TrialSet
    notes: tuple[str, ...]


def identify_simulation(
    realization: Realization,
    trials: TrialSet,
    *,
    inherited: PatchedModel | None = None,
    threads: int = 0,
    progress: Callable[[float], None] = lambda fraction: None,
    plan: StagePlan | None = None,
) -> SimulationResult:
    """Fit effects stage by stage; a stage that is accepted is frozen.

    Args:
        trials: recordings with commands.
        inherited: effects of an earlier diagnosis that the MJCF does not contain.
        threads: number of threads of the simulation, 0 for all cores.
        progress: called with the fraction done.
        plan: stages that are fitted, and their effects; by default all.

    Raises:
        RecordingError: the model and the recordings share no joint.
        SimulationError: the model diverges on every recording.
    """
    notes: list[str] = []
    plan = plan or StagePlan()
    setup = ModelSetup.of(realization, inherited, threads)
    fit_alone = replace(trials, held_out=())
    with np.errstate(over="ignore", invalid="ignore"):
        signals = _determine_signals(setup, fit_alone)
        used = signals.apply(trials)
        prepared, used = build_problem(setup, used, notes)
        problem = prepared.problem
        modes = [
            _KNOWN if joint in plan.known_drives else problem.simulator.segments[0].mode_of(j)
            for j, joint in enumerate(problem.joints)
        ]
        first = first_values(problem)
        weights = _segment_weights(problem, start(_drives(modes), problem.scales, first))
        weighted = replace(problem, position_weights=weights)
        staged = StagedFit(setup, used, replace(prepared, problem=weighted), modes, first, plan)
        staged.run(progress)
        found, stage_of = staged.found, staged.stage_of
        stages, undetermined = list(staged.stages.values()), dict[Term, StageName]()
        if not skips("which values of the model hold"):
            undetermined = undetermined_terms(weighted, found, modes, plan.order)
            stages = [_as_the_model_says(one, undetermined) for one in stages]
        slopes = with_derivatives(weighted, found)
        spread = parameter_uncertainty(weighted.at(found), slopes)
        stages = [_with_data(one, weighted, slopes, stage_of, used) for one in stages]
        # The errors that are reported count every recording alike.
        before, after = (residuals_everywhere(problem, h) for h in (EMPTY, found))
        errors = joint_errors(prepared, before, after)
    return SimulationResult(
        prepared, found, stage_of, spread, tuple(stages), undetermined, errors, signals, used,
        (*used.notes, *notes),
    )  # fmt: skip


def _determine_signals(setup: ModelSetup, trials: TrialSet) -> RecordedSignals:
    """Meaning of the recorded commands; as the model has them if the run must end."""
    try:
        with ending_at_limit():
            return determine_signals(setup, trials)
    except OutOfTime:
        skips("what the commands and efforts of the recordings are")
        return RecordedSignals()


def _as_the_model_says(stage: Stage, undetermined: Mapping[Term, StageName]) -> Stage:
    """Return the stage with the reason if the motion shows that the model's values hold."""
    if stage.state != "not_observable" or stage.name in undetermined.values():
        return stage
    why = (
        "the model's values hold: the motion would show a difference, and at no joint does the "
        "held-out error fall by more than chance explains"
    )
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
    rows = np.einsum("tsp,s->tp", slopes.jacobian[..., columns] ** 2, weights)
    each = np.split(rows, np.cumsum(problem.lengths(problem.fit))[:-1])
    names = [trials.fit[problem.simulator.segments[s].trial].path.name for s in problem.fit]
    return replace(stage, data=shares(names, np.array([own.sum(axis=0) for own in each])))


def _drives(modes: Sequence[str]) -> list[Term]:
    return list(dict.fromkeys([*terms_of("drive", modes), *nuisance_of("encoder", (), modes)]))


def _segment_weights(problem: Problem, hypothesis: Hypothesis) -> dict[int, FloatArray]:
    """Segment -> (joints,) weights: one that is predicted far worse than most counts less.

    In it the robot did what no stage describes (a drive that was switched off, a hand). Its errors
    would otherwise decide every parameter. Weights are on top of the problem's own.
    """
    count = len(problem.joints)
    sizes = np.array([
        np.sqrt(np.mean(problem.residuals([hypothesis], np.array([s]))[0][:, :count] ** 2, axis=0))
        for s in problem.all_segments
    ])  # fmt: skip
    sizes = np.where(np.isfinite(sizes), sizes, np.inf)
    usual = np.median(sizes[problem.fit], axis=0)
    weights = np.minimum(1.0, usual / np.maximum(sizes, 1e-12))
    ones = np.ones(count)
    return {
        int(s): problem.position_weights.get(int(s), ones) * weights[s]
        for s in problem.all_segments
    }
