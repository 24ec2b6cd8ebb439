"""Staged identification by the simulation error of the closed loop.

Each stage is a fit of the diagnosis with a given list of effects; nothing is searched.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.intervals import Spread, parameter_spread
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import AppliedEffect, Patched
from pytest_twin.diagnosis.physical_totals import at_zero
from pytest_twin.diagnosis.prepare import Prepared
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded import Settled, settle
from pytest_twin.diagnosis.search_result import build_problem, joint_errors, residuals_everywhere
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.identification.simulation.equation_error import first_values
from pytest_twin.identification.simulation.stage_effects import (
    EXCLUDES,
    SIMULATED,
    nuisance_of,
    start,
    terms_of,
)
from pytest_twin.identification.stages import HeldOut, Stage, StageName, judged
from pytest_twin.realization import Realization

_ITERATIONS, _LAST = 8, 10
_LEAST_GAIN = 0.002
"""A stage lowers the held-out error by at least this share, or its effects are not kept."""


@dataclass(frozen=True)
class SimulationResult:
    """What commands and positions say.

    Attributes:
        prepared: the problem of the final parameters.
        hypothesis: all accepted terms, fitted together.
        stage_of: term -> stage that accepted it.
        spread: of the final parameters.
        stages: in order.
        errors: joint -> error on what is held out, or fitted where nothing is.
        settled: what the recordings are.
        trials: as they were used.
        notes: one line each.
    """

    prepared: Prepared
    hypothesis: Hypothesis
    stage_of: dict[Term, StageName]
    spread: Spread
    stages: tuple[Stage, ...]
    errors: dict[str, JointError]
    settled: Settled
    trials: TrialSet
    notes: tuple[str, ...]


def identify_simulation(
    realization: Realization,
    trials: TrialSet,
    *,
    inherited: Patched | None = None,
    threads: int = 0,
    progress: Callable[[float], None] = lambda fraction: None,
) -> SimulationResult:
    """Fit effects stage by stage; a stage that is accepted is frozen.

    Args:
        realization: the nominal model.
        trials: recordings with commands.
        inherited: effects that an earlier diagnosis stepped beside the model.
        threads: of the simulation, 0 for all.
        progress: told the fraction done.

    Raises:
        RecordingError: the model and the recordings share no joint.
        SimulationError: the model diverges on every recording.
    """
    notes: list[str] = []
    given = ModelSetup.of(realization, inherited, threads)
    fit_alone = replace(trials, held_out=())
    with np.errstate(over="ignore", invalid="ignore"):
        settled = settle(given, fit_alone)
        used = settled.applied(trials)
        prepared, used = build_problem(given, used, notes)
        problem = prepared.problem
        modes = [problem.simulator.segments[0].mode_of(j) for j in range(len(problem.joints))]
        first = first_values(problem)
        problem.trust = _balanced(problem, start(_drives(modes), problem.scales, first))
        found = EMPTY
        stages: list[Stage] = []
        stage_of: dict[Term, StageName] = {}
        for k, name in enumerate(SIMULATED):
            stage, accepted = _stage(given, used, prepared, name, found, first, modes)
            stages.append(stage)
            for term in accepted.terms:
                found = found.with_term_of(accepted, term)
                stage_of[term] = name
            progress((k + 1) / (len(SIMULATED) + 1))
        found, last, whole = _together(problem, found, stage_of, stages)
        stages = [*last, whole]
        fitted = _with_slopes(problem, found)
        spread = parameter_spread(problem, fitted)
        # The errors that are reported count every recording alike.
        problem.trust = {}
        before, after = (residuals_everywhere(problem, h) for h in (EMPTY, found))
        errors = joint_errors(prepared, before, after)
    return SimulationResult(
        prepared, found, stage_of, spread, tuple(stages), errors, settled, used,
        (*used.notes, *notes),
    )  # fmt: skip


def _stage(
    given: ModelSetup,
    trials: TrialSet,
    whole: Prepared,
    name: StageName,
    found: Hypothesis,
    first: FloatArray,
    modes: Sequence[str],
) -> tuple[Stage, Hypothesis]:
    """Fit one stage on top of what is frozen; its terms, where they are accepted."""
    beside = (*given.beside, *applied(whole.problem, found))
    prepared = replace(given, beside=beside).prepared(
        trials.fit, trials.held_out, whole.window, scales=whole.problem.scales
    )
    problem = prepared.problem
    problem.floor, problem.trust = whole.problem.floor, whole.problem.trust
    own = terms_of(name, modes)
    others = nuisance_of(name, found.terms, modes)
    without = _fitted(problem, others, first)
    with_it = _fitted(problem, [*own, *others], first)
    kept = with_it.hypothesis.without(*others)
    held = HeldOut(
        _error(problem, without.hypothesis), _error(problem, with_it.hypothesis), "noise floors"
    )
    words = tuple(f"{place_of(problem, t)}.{t.effect}" for t in own)
    stage = judged(Stage(name, "accepted", "", words, None, EXCLUDES[name]), held)
    if held.after > (1.0 - _LEAST_GAIN) * held.before and stage.state == "accepted":
        stage = replace(
            stage, state="not_observable",
            why=f"the motion shows none of it: {stage.why}", parameters=(),
        )  # fmt: skip
    if stage.state != "accepted":
        return stage, EMPTY
    return stage, kept


def _together(
    problem: Problem,
    found: Hypothesis,
    stage_of: dict[Term, StageName],
    stages: Sequence[Stage],
) -> tuple[Hypothesis, list[Stage], Stage]:
    """Fit all accepted terms together in the closed loop; a stage that moves is reopened."""
    name: StageName = "closed_loop"
    if not found.terms:
        why = "no stage before was accepted: there is nothing to fit together"
        return found, list(stages), Stage(name, "not_observable", why, (), None, EXCLUDES[name])
    apart = _with_slopes(problem, found)
    weights = problem.weights(np.mean(apart.residual**2, axis=0))
    (moved,) = fit(problem, [found], weights, problem.fit, iterations=_LAST, slopes=False)
    moved = _with_slopes(problem, _possible(problem, moved.hypothesis))
    held = HeldOut(_error(problem, found), _error(problem, moved.hypothesis), "noise floors")
    words = tuple(f"{place_of(problem, t)}.{t.effect}" for t in found.terms)
    stage = judged(Stage(name, "accepted", "", words, None, EXCLUDES[name]), held)
    if stage.state != "accepted":
        return found, list(stages), stage
    off = np.abs(moved.hypothesis.theta - found.theta)
    beyond = off > np.maximum(parameter_spread(problem, moved).half_width, 1e-9)
    reopened = {stage_of[t] for t in found.terms if beyond[found.slice_of(t)].any()}
    said = [
        replace(
            one,
            state="reopened",
            why=f"{one.why}; all accepted parameters fitted together move it beyond its 95 % "
            f"interval, and the held-out error falls from {held.before:.3g} to {held.after:.3g} "
            "noise floors",
        )
        if one.name in reopened
        else one
        for one in stages
    ]
    return moved.hypothesis, said, stage


def _drives(modes: Sequence[str]) -> list[Term]:
    return [*terms_of("drive", modes), *nuisance_of("encoder", (), modes)]


def _balanced(problem: Problem, hypothesis: Hypothesis) -> dict[int, FloatArray]:
    """Segment -> (joints,) weights: one that is predicted far worse than most counts less.

    In it the robot did what no stage describes (a drive that was switched off, a hand). Its errors
    would otherwise decide every parameter. Weights are on top of the problem's own.
    """
    count = len(problem.joints)
    sizes = np.array([
        np.sqrt(np.mean(problem.residuals([hypothesis], np.array([s]))[0][:, :count] ** 2, axis=0))
        for s in problem.everywhere
    ])  # fmt: skip
    sizes = np.where(np.isfinite(sizes), sizes, np.inf)
    usual = np.median(sizes[problem.fit], axis=0)
    weights = np.minimum(1.0, usual / np.maximum(sizes, 1e-12))
    ones = np.ones(count)
    return {int(s): problem.trust.get(int(s), ones) * weights[s] for s in problem.everywhere}


def _fitted(problem: Problem, terms: Sequence[Term], first: FloatArray) -> Fitted:
    """A fit from the first values."""
    begun = start(terms, problem.scales, first) if terms else EMPTY
    residual = problem.residuals([begun], problem.fit)[0]
    weights = problem.weights(np.mean(residual**2, axis=0))
    (found,) = fit(problem, [begun], weights, problem.fit, iterations=_ITERATIONS, slopes=False)
    possible = _possible(problem, found.hypothesis)
    return fit(problem, [possible], weights, problem.fit, iterations=0, slopes=False)[0]


def _possible(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    """The hypothesis with totals of model and corrections of at least zero: no joint pushes
    itself.
    """
    return hypothesis.with_theta(at_zero(problem, hypothesis))


def _with_slopes(problem: Problem, hypothesis: Hypothesis) -> Fitted:
    residual = problem.residuals([hypothesis], problem.fit)[0]
    weights = problem.weights(np.mean(residual**2, axis=0))
    return fit(problem, [hypothesis], weights, problem.fit, iterations=0)[0]


def _error(problem: Problem, hypothesis: Hypothesis) -> float:
    """Root mean square of all position errors in noise floors, on what is held out."""
    residual: FloatArray = problem.residuals([hypothesis], problem.tested)[0]
    count = len(problem.joints)
    value = float(np.sqrt(np.mean((residual[:, :count] / problem.floor) ** 2)))
    return value if np.isfinite(value) else 1e9


def place_of(problem: Problem, term: Term) -> str:
    """Name of the joint that a term acts at, or ``robot``."""
    return "robot" if term.joint < 0 else problem.joints[term.joint]


def applied(problem: Problem, hypothesis: Hypothesis) -> tuple[AppliedEffect, ...]:
    """The terms of a hypothesis as effects with SI values."""
    found = []
    for term in hypothesis.terms:
        theta = hypothesis.theta[hypothesis.slice_of(term)]
        values = {
            p.name: float(t * problem.scales.value(p, term.joint))
            for p, t in zip(term.parameters, theta, strict=True)
        }
        joint = None if term.joint < 0 else problem.joints[term.joint]
        found.append(AppliedEffect(term.effect, joint, values, in_model=False))
    return tuple(found)
