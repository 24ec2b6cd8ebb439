"""Staged identification by the simulation error of the closed loop.

Each stage is a fit of the diagnosis with a given list of effects; nothing is searched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.intervals import Spread, parameter_spread
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import AppliedEffect, Patched
from pytest_twin.diagnosis.prepare import Prepared
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded import RecordedSignals, determine_signals
from pytest_twin.diagnosis.search_result import build_problem, joint_errors, residuals_everywhere
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.identification.simulation.equation_error import first_values
from pytest_twin.identification.simulation.fitting import (
    LEAST_GAIN,
    add_effects,
    fit_terms,
    held_out_error,
    refitted,
    take_better_terms,
    with_derivatives,
    with_possible_totals,
)
from pytest_twin.identification.simulation.stage_effects import (
    EXCLUDES,
    FURTHER,
    SIMULATED,
    nuisance_of,
    start,
    terms_of,
)
from pytest_twin.identification.simulation.undetermined import undetermined_terms
from pytest_twin.identification.stages import HeldOut, Stage, StageName, judge_stage, shares
from pytest_twin.realization import Realization

_LAST = 10
"""Iterations of the fit of all accepted terms together."""


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

    prepared: Prepared
    hypothesis: Hypothesis
    stage_of: dict[Term, StageName]
    spread: Spread
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
    inherited: Patched | None = None,
    threads: int = 0,
    progress: Callable[[float], None] = lambda fraction: None,
) -> SimulationResult:
    """Fit effects stage by stage; a stage that is accepted is frozen.

    Args:
        realization: the nominal model.
        trials: recordings with commands.
        inherited: effects of an earlier diagnosis that the MJCF does not contain.
        threads: number of threads of the simulation, 0 for all cores.
        progress: called with the fraction done.

    Raises:
        RecordingError: the model and the recordings share no joint.
        SimulationError: the model diverges on every recording.
    """
    notes: list[str] = []
    given = ModelSetup.of(realization, inherited, threads)
    fit_alone = replace(trials, held_out=())
    with np.errstate(over="ignore", invalid="ignore"):
        signals = determine_signals(given, fit_alone)
        used = signals.applied(trials)
        prepared, used = build_problem(given, used, notes)
        problem = prepared.problem
        modes = [problem.simulator.segments[0].mode_of(j) for j in range(len(problem.joints))]
        first = first_values(problem)
        problem.position_weights = _balanced(problem, start(_drives(modes), problem.scales, first))
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
        found, last, whole = _together(problem, found, stage_of, stages, modes)
        if found.terms and held_out_error(problem, found) > VERDICT.stands_out:
            found, last, whole = _asked_again(
                given, used, prepared, (found, last, whole), stage_of, first, modes
            )
        undetermined = undetermined_terms(problem, found, modes)
        stages = [*(_as_the_model_says(one, undetermined) for one in last), whole]
        slopes = with_derivatives(problem, found)
        spread = parameter_spread(problem, slopes)
        stages = [_with_data(one, problem, slopes, stage_of, used) for one in stages]
        # The errors that are reported count every recording alike.
        problem.position_weights = {}
        before, after = (residuals_everywhere(problem, h) for h in (EMPTY, found))
        errors = joint_errors(prepared, before, after)
    return SimulationResult(
        prepared, found, stage_of, spread, tuple(stages), undetermined, errors, signals, used,
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
    """Fit one stage with the accepted terms of earlier stages fixed."""
    outside_mjcf = (*given.outside_mjcf, *applied(whole.problem, found))
    prepared = replace(given, outside_mjcf=outside_mjcf).prepared(
        trials.fit, trials.held_out, whole.window, scales=whole.problem.scales
    )
    problem = prepared.problem
    problem.floor, problem.position_weights = whole.problem.floor, whole.problem.position_weights
    own = terms_of(name, modes)
    others = nuisance_of(name, found.terms, modes)
    without = fit_terms(problem, others, first)
    whole_fit = take_better_terms(problem, without, fit_terms(problem, [*own, *others], first))
    whole_fit = add_effects(problem, whole_fit, FURTHER.get(name, ()), modes)
    free = set(others)
    kept = whole_fit.without(*(t for t in whole_fit.terms if t in free))
    held = HeldOut(
        held_out_error(problem, without), held_out_error(problem, whole_fit), "noise floors"
    )
    words = tuple(f"{place_of(problem, t)}.{t.effect}" for t in kept.terms)
    stage = judge_stage(Stage(name, "accepted", "", words, None, EXCLUDES[name]), held)
    if not kept.terms or held.after > (1.0 - LEAST_GAIN) * held.before:
        stage = replace(
            stage, state="not_observable", parameters=(),
            why="the motion shows none of it: at no joint does the held-out error fall by more "
            "than chance explains",
        )  # fmt: skip
    if stage.state != "accepted":
        return stage, EMPTY
    return stage, kept


_FURTHER_EFFECTS = frozenset(effect for each in FURTHER.values() for effect in each)


def _asked_again(
    given: ModelSetup,
    trials: TrialSet,
    whole: Prepared,
    before: tuple[Hypothesis, list[Stage], Stage],
    stage_of: dict[Term, StageName],
    first: FloatArray,
    modes: Sequence[str],
) -> tuple[Hypothesis, list[Stage], Stage]:
    """Fit each stage again if a residual remains, with what later stages have found.

    The first time a stage was fitted without the effects of later ones: a friction stage cannot
    succeed while the drive lacks its limit. All parameters are then fitted together, and stay as
    they were if the held-out error does not fall.

    Args:
        before: fitted terms, stages, and the stage that fits all together.
        stage_of: term -> stage that fits it; new terms are added.
    """
    problem = whole.problem
    found, stages, together = before
    error = held_out_error(problem, found)
    for name in SIMULATED:
        others = found.without(*(t for t in found.terms if stage_of[t] == name))
        # Further effects stay as they are. Friction, gains and armature, which compensate for one
        # another, are free again.
        frozen = others.without(*(t for t in others.terms if t.effect not in _FURTHER_EFFECTS))
        _, accepted = _stage(given, trials, whole, name, frozen, first, modes)
        if not accepted.terms:
            continue
        proposed = others
        for term in accepted.terms:
            proposed = proposed.with_term_of(accepted, term)
        merged = take_better_terms(problem, found, refitted(problem, proposed))
        less = held_out_error(problem, merged)
        if less > (1.0 - LEAST_GAIN) * error:
            continue
        for term in merged.terms:
            stage_of.setdefault(term, name)
        why = (
            f"fitted again with what later stages had found, and the held-out error falls from "
            f"{error:.3g} to {less:.3g} noise floors"
        )
        stages = [
            replace(one, state="reopened", why=f"{one.why}; {why}") if one.name == name else one
            for one in stages
        ]
        found, error = merged, less
    if found is before[0]:
        return before
    words = {
        name: tuple(
            f"{place_of(problem, t)}.{t.effect}" for t in found.terms if stage_of[t] == name
        )
        for name in SIMULATED
    }
    stages = [replace(one, parameters=words[one.name]) for one in stages]
    held = HeldOut(together.held_out.before if together.held_out else error, error, "noise floors")
    every = tuple(f"{place_of(problem, t)}.{t.effect}" for t in found.terms)
    together = judge_stage(replace(together, why="", parameters=every), held)
    return found, stages, together


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
    slopes: Fitted,
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


def _together(
    problem: Problem,
    found: Hypothesis,
    stage_of: dict[Term, StageName],
    stages: Sequence[Stage],
    modes: Sequence[str],
) -> tuple[Hypothesis, list[Stage], Stage]:
    """Fit all accepted terms together in the closed loop; a stage that moves is reopened."""
    name: StageName = "closed_loop"
    if not found.terms:
        why = "no stage before was accepted: there is nothing to fit together"
        return found, list(stages), Stage(name, "not_observable", why, (), None, EXCLUDES[name])
    problem.refine_at(found)
    residual = problem.residuals([found], problem.fit)[0]
    weights = problem.weights(np.mean(residual**2, axis=0))
    (tried,) = fit(problem, [found], weights, problem.fit, iterations=_LAST, slopes=False)
    moved = with_possible_totals(problem, tried.hypothesis)
    before = held_out_error(problem, found)
    if held_out_error(problem, moved) > before:
        moved = found
    # What a frozen stage has taken up may hide an effect: with all parameters free it shows.
    whole = add_effects(problem, moved, [e for each in FURTHER.values() for e in each], modes)
    added = [t for t in whole.terms if t not in stage_of]
    for term in added:
        stage_of[term] = next(k for k, each in FURTHER.items() if term.effect in each)
    held = HeldOut(before, held_out_error(problem, whole), "noise floors")
    words = tuple(f"{place_of(problem, t)}.{t.effect}" for t in whole.terms)
    stage = judge_stage(Stage(name, "accepted", "", words, None, EXCLUDES[name]), held)
    if stage.state != "accepted":
        return found, list(stages), stage
    half = parameter_spread(problem, with_derivatives(problem, whole)).half_width
    reopened = {stage_of[t] for t in added}
    for term in found.terms:
        if term in whole.terms:
            own = whole.slice_of(term)
            off = np.abs(whole.theta[own] - found.theta[found.slice_of(term)])
            if np.any(off > np.maximum(half[own], 1e-9)):
                reopened.add(stage_of[term])
    said = [
        replace(
            one,
            state="reopened",
            why=f"{one.why}; all accepted parameters fitted together move it beyond its 95 % "
            f"interval or add an effect to it, and the held-out error falls from {held.before:.3g} "
            f"to {held.after:.3g} noise floors",
        )
        if one.name in reopened
        else one
        for one in stages
    ]
    return whole, said, stage


def _drives(modes: Sequence[str]) -> list[Term]:
    return list(dict.fromkeys([*terms_of("drive", modes), *nuisance_of("encoder", (), modes)]))


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
    return {
        int(s): problem.position_weights.get(int(s), ones) * weights[s] for s in problem.everywhere
    }


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
        found.append(AppliedEffect(term.effect, joint, values, is_in_mjcf=False))
    return tuple(found)
