"""A diagnosis from recordings to findings and the unexplained residual."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pytest_twin.diagnosis.alternative_sets import with_alternative_sets, without_alternative_sets
from pytest_twin.diagnosis.coarse_step import notes_on_coarse_step
from pytest_twin.diagnosis.conclusion import ChosenModel, assess, with_final_parameters
from pytest_twin.diagnosis.cost import Cost, cost
from pytest_twin.diagnosis.deadline import OutOfTime
from pytest_twin.diagnosis.findings import Explained, finding_json
from pytest_twin.diagnosis.friction_constraint import (
    CREEPS,
    build_problem_as_friction_acts,
    refit_as_friction_acts,
    search_as_friction_acts,
)
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis
from pytest_twin.diagnosis.integrator_detection import (
    as_simulated_before,
    describe_integrator,
    detect_integrator,
    explains_more,
)
from pytest_twin.diagnosis.integrator_of_findings import with_detected_timestep
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import Patched
from pytest_twin.diagnosis.prepare import Prepared, shared_joints
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded import Settled, settle, with_doubt, with_fewer_effects
from pytest_twin.diagnosis.roles import Roles, roles_of
from pytest_twin.diagnosis.run import Run, not_tried
from pytest_twin.diagnosis.search.scored_model import SelectedModel
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    build_problem,
    confirm,
    from_start,
    refit_whole_motions,
    refit_with_full_drive,
    residuals_everywhere,
    search,
)
from pytest_twin.diagnosis.trace import Trace
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.unexplained import UnexplainedResidual, unexplained
from pytest_twin.diagnosis.unit_check import drop_other_units
from pytest_twin.diagnosis.unnamed_law.fit import FreeLaws
from pytest_twin.diagnosis.unnamed_law.tested import TestedLaws, laws_left, on_test
from pytest_twin.diagnosis.verdict import JointError, Verdict
from pytest_twin.diagnosis.window_length import (
    SHORTEST,
    model_follows_recordings,
    typical_window_length,
)
from pytest_twin.diagnosis.windows import WINDOW, segments_of
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.errors import RecordingError
from pytest_twin.realization import Realization
from pytest_twin.recording_options import CommandBetween
from pytest_twin.trial import Trial

# Share of the squared mismatch that may be left along the motion where a law of the catalogue is
# worth a search in windows.
_CLEAR = 0.1
_OF_WHOLE = 0.5
"""Share of the simulations for whole recordings of a motion that windows may follow better."""
_CONTACT = "contact"
_IN_WINDOWS = (
    f"all errors are of predictions over windows of {WINDOW:g} s that start from measured states: "
    "over whole recordings small errors of this motion grow (an oscillating servo, a falling arm, "
    "an integrated velocity)"
)

_NAMED_IN_WINDOWS = (
    f"the effects were selected in windows of {WINDOW:g} s that start from measured states, and "
    "fitted over whole recordings: over whole recordings stick-slip motion separates effects less"
)

_AS_A_DRIVE = (
    "all drive parameters were fitted together, because stick-slip motion does not separate them; "
    "alternatives to the findings with 50 % confidence were not tested"
)


@dataclass(slots=True)
class Diagnosis:
    """Result of a diagnosis.

    Attributes:
        verdict: one word.
        explained: findings.
        errors: joint -> prediction error on held-out recordings, or on all if none is held out.
        left: joint -> unexplained residual, only for joints that cause it.
        notes: one line each, for the reader.
        prepared, selected: problem of the final parameters, and model selection.
        tested: problem, recordings and residuals behind the errors.
        free: laws without a name for a part of the residual.
        roles: which recordings were fitted, validated, and held out.
        trace: every step of the search.
        cost: computing time.
        settled: what the recordings are.
        untried: what was not done because time or simulations ran out, one line each.
    """

    verdict: Verdict
    explained: Explained
    errors: Mapping[str, JointError]
    left: Mapping[str, UnexplainedResidual]
    notes: tuple[str, ...]
    prepared: Prepared
    selected: SelectedModel
    tested: SearchResult
    free: TestedLaws
    roles: Roles
    trace: Trace
    cost: Cost
    settled: Settled
    untried: tuple[str, ...]

    @property
    def has_held_out(self) -> bool:
        """Whether any recording was held out."""
        return bool(len(self.tested.prepared.problem.held_out))

    def to_json(self, *, realization: str) -> dict[str, Any]:
        """``diagnosis.json``, schema 1."""
        tested = self.tested.prepared
        return {
            "schema": 1,
            "verdict": self.verdict,
            "findings": [
                *(finding_json(f) for f in self.explained.findings if not f.small),
                *self.free.findings_json,
            ],
            "small_corrections": [finding_json(f) for f in self.explained.findings if f.small],
            "held_out": {
                joint: {
                    "rms_before": e.before,
                    "rms_after": e.after,
                    "floor": e.floor,
                    "unit": e.unit,
                }
                for joint, e in self.errors.items()
            },
            "floor": {
                source: dict(zip(tested.problem.joints, map(float, rms), strict=True))
                for source, rms in tested.floor_parts.items()
            },
            "unexplained": {
                joint: {
                    "fraction": round(item.fraction, 5),
                    "where": item.where.summary,
                    "windows": dict(item.where.windows),
                    **self._modelled(joint),
                }
                for joint, item in self.left.items()
            },
            "realization": realization,
            "trials": self._trials(),
            "recordings": self.settled.to_json(
                [*self.tested.trials.fit, *self.tested.trials.held_out]
            ),
            "notes": list(self.notes),
            "not_tried": list(self.untried),
            "search_trace": self.trace.to_json(),
            "cost": self.cost.to_json(),
        }

    def _modelled(self, joint: str) -> dict[str, float]:
        """What laws without a name remove of the unexplained error of a joint."""
        removed = self.free.removed(joint)
        return {} if removed is None else {"unnamed_law_removes": round(removed, 5)}

    def _trials(self) -> dict[str, list[str]]:
        """Names of the recordings that were used, by role."""
        used, validates = self.tested.trials, {t.path for t in self.roles.validation}
        return {
            "fit": _names([t for t in used.fit if t.path not in validates]),
            "validation": _names([t for t in used.fit if t.path in validates]),
            "held_out": _names(used.held_out),
        }


def _names(trials: Sequence[Trial]) -> list[str]:
    return list(dict.fromkeys(t.path.name for t in trials))


def diagnose(
    realization: Realization,
    trials: TrialSet,
    *,
    inherited: Patched | None = None,
    threads: int = 0,
    run: Run | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Diagnosis:
    """Diagnose a model: locate errors, identify effects, fit them, and test them.

    Effects are chosen and fitted without the held-out recordings, which are opened once, at the
    end.

    Args:
        realization: the nominal model.
        trials: the recordings.
        inherited: effects of an earlier diagnosis that the MJCF of ``realization`` cannot hold.
        threads: threads of batch simulations, 0 for all cores.
        run: the time that it may take, and who is told of its steps; by default as long as it
            takes.
        progress: called with the fraction done.

    Raises:
        RecordingError: model and recordings share no joint, or angles are not in rad.
        SpecError: a controller, payload or actuator is missing in the model.
    """
    since = time.perf_counter()
    run = Run() if run is None else run
    given, known = ModelSetup.of(realization, inherited, threads), roles_of(trials).of_search
    with run.budget.searching():
        settled = run.attempt(
            "what the commands and efforts of the recordings are",
            lambda: settle(given, known), Settled(),
        )  # fmt: skip
    read, trials = trials, settled.applied(trials)
    roles = roles_of(trials)
    open_ = settled.doubted(roles.of_search.fit)
    for i, trial in enumerate(roles.test):
        # What a recording asks of the model is missing now, not after a search of minutes.
        segments_of(realization, trial, i, shared_joints(realization, [trial]), commanded=True)
    # Diverging candidates overflow; values that are not finite are ranked last.
    with np.errstate(over="ignore", invalid="ignore"):
        structure = find_structure(
            realization, roles.of_search,
            inherited=inherited, threads=threads, run=run, progress=progress,
            possible=() if open_ is None else open_.possible,
        )  # fmt: skip
        if open_ is not None and structure.between is not None:
            settled = settled.decided(open_, structure.between)
            trials, open_ = settled.applied(read), None
            roles = roles_of(trials)
        progress(0.85)
        laws = _laws_left(structure, run)
        progress(0.88)
        assessed = assess(structure, trials, roles.test)
        tested, left = assessed.tested, dict[str, UnexplainedResidual]()
        if tested.verdict in ("improved", "unexplained"):
            left = unexplained(tested, *assessed.near)
        free = on_test(laws, structure.found.prepared.problem, tested, searched_all=not run.untried)
        progress(0.9)
        step = notes_on_coarse_step(
            tested.prepared.problem, tested.explained.hypothesis, tested.errors
        )
    notes = [*trials.notes, roles.note, *structure.notes, *assessed.notes, *free.notes, *step]
    notes += not_tried(run)
    progress(0.94)
    for problem in (*settled.problems, *assessed.problems):
        run.budget.add(problem)
    explained = with_doubt(assessed.explained, open_)
    return Diagnosis(
        tested.verdict, explained, free.tested.errors, left, tuple(dict.fromkeys(notes)),
        structure.found.prepared, structure.found.selected, free.tested, free, roles, run.trace,
        cost(run.budget, since, structure.rival_simulations), settled, tuple(run.untried),
    )  # fmt: skip


def _laws_left(structure: ChosenModel, run: Run) -> FreeLaws:
    """Laws without a name for the residual, if time remains."""
    try:
        with run.budget.fitting():
            return laws_left(structure.given, structure.found, structure.near)
    except OutOfTime:
        run.skip("a law without a name for the unexplained residual")
        return FreeLaws((), structure.found.explained.hypothesis, ())


def find_structure(
    realization: Realization,
    trials: TrialSet,
    *,
    inherited: Patched | None = None,
    threads: int = 0,
    run: Run | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
    possible: Sequence[CommandBetween] = (),
) -> ChosenModel:
    """Choose effects and fit them; no test recording is known here.

    Args:
        realization: the nominal model.
        trials: the fit recordings, and as held out the validation recordings.
        inherited, threads, run, progress, errors: as :func:`diagnose`.
        possible: what commands may do between stamps, where the recordings do not tell.
    """
    run = Run() if run is None else run
    notes: list[str] = []
    given = ModelSetup.of(realization, inherited, threads)
    progress(0.02)
    trials = drop_other_units(realization, trials, notes)
    given, prepared, trials = build_problem_as_friction_acts(given, trials, notes)
    everything = (*trials.fit, *trials.held_out)
    notes += _left_out_joints(realization, everything, prepared.problem.joints)
    progress(0.06)
    run.trace.listeners.append(lambda step: progress(0.06 + 0.74 * run.share_done))
    given, prepared, trials = as_simulated_before(given, prepared, trials, run)
    with run.budget.searching():
        sought = _sought(given, prepared, trials, run)
    given, notes = sought.given, [*notes, *sought.notes]
    progress(0.82)
    with run.budget.searching():
        fewer = run.attempt(
            "other commands between their stamps",
            lambda: with_fewer_effects(sought.found, given, possible, run), None,
        )  # fmt: skip
        likeliest, between = (sought.found, None) if fewer is None else fewer
        found, simulations = run.attempt(
            "other sets of effects instead of the final one",
            lambda: with_alternative_sets(likeliest, run),
            (without_alternative_sets(likeliest), 0.0),
        )
    found = with_final_parameters(found, run.budget)
    if given.creeps:
        notes.append(CREEPS)
    if given.substeps:
        notes.append(describe_integrator(found.prepared))
    notes += found.explained.notes
    return ChosenModel(given, found, sought.near, tuple(notes), simulations, between)


@dataclass(frozen=True, slots=True)
class _Sought:
    """What was found, how the model was stepped for it, the windows in which the rest is located,
    None for none, and what a reader has to know.
    """

    given: ModelSetup
    found: SearchResult
    near: float | None
    notes: tuple[str, ...]


def _sought(given: ModelSetup, prepared: Prepared, trials: TrialSet, run: Run) -> _Sought:
    """Search whole motions, and windows of them where these tell more.

    Every step after the first search has its result to fall back on, where time runs out.

    Args:
        given: the model, and how it is stepped.
        prepared, trials: its problem over whole motions.
        run: the diagnosis.
    """
    notes: list[str] = []
    problem = prepared.problem
    run.budget.add(problem)
    contact = problem.simulator.models.contact
    clear, start = EMPTY, EMPTY
    if contact.world.size:
        away = run.attempt(
            "the search for effects far from contact",
            lambda: _found_away(given, trials, contact, run), None,
        )  # fmt: skip
        if away is not None:
            clear = start = away
            start = run.attempt(
                "contact effects in addition", lambda: _with_contact(problem, clear, run), clear
            )
    run.begin(_stage(problem), problem)
    with run.budget.reserved():
        share = _share_of_whole(problem)
    with run.budget.part(share):
        given, found = search_as_friction_acts(given, prepared, trials, run, start)
    if found.diverges_from_recordings and contact.world.size:
        found = run.attempt("contact effects once more", partial(_once_more, found, run), found)
    elif found.leaves_recordings and not contact.world.size:
        found = run.attempt(
            "a search from shorter windows", partial(_by_shorter, found, given, run), found
        )
    given, found = run.attempt(
        "dry friction that creeps otherwise",
        partial(refit_as_friction_acts, found, given, run),
        (given, found),
    )
    other = run.attempt(
        "recordings of a simulation", partial(_stepped_otherwise, found, given, run), None
    )
    if other is not None:
        return other
    simulated = run.attempt(
        "the integration error of a simulation",
        partial(with_detected_timestep, found, given, run),
        None,
    )
    if simulated is not None:
        given, found = simulated
    near: float | None = None
    if found.diverges_from_recordings and (clear.terms or not contact.world.size):
        near = WINDOW
        found, said = run.attempt(
            f"windows of {WINDOW:g} s",
            partial(_by_windows, found, given, trials, clear, run),
            (found, list[str]()),
        )
        notes += said
    return _Sought(given, found, near, tuple(notes))


def _stepped_otherwise(found: SearchResult, given: ModelSetup, run: Run) -> _Sought | None:
    """What is found with the integration error of a simulation's step left in, if that explains
    more; None if not, or if no such error is seen.
    """
    stepped = detect_integrator(found, given)
    if stepped is None:
        return None
    prepared, trials = build_problem(stepped, found.trials, [])
    other = _sought(stepped, prepared, trials, run)
    return other if explains_more(other.found, found) else None


def _by_windows(
    found: SearchResult, given: ModelSetup, trials: TrialSet, clear: Hypothesis, run: Run
) -> tuple[SearchResult, list[str]]:
    """What explains most, of whole motions and windows of them, and what a reader has to know."""
    cut, kept = build_problem(given, trials, [], window=WINDOW)
    run.begin(f"windows of {WINDOW:g} s", cut.problem)
    if cut.problem.simulator.models.contact.world.size:
        # What acts in the air is known from there.
        cut.problem.family = _CONTACT

    def longer() -> Prepared:
        halves, _ = build_problem(given, trials, [], window=_half_of(trials))
        run.begin("windows of half a recording", halves.problem)
        return halves

    notes: list[str] = []
    return _windowed(found, cut, kept, clear, run, notes, longer), notes


def _posed_away(
    given: ModelSetup, trials: TrialSet, contact: ContactGeoms
) -> tuple[Prepared, TrialSet] | None:
    """The problem in windows that are far from what the robot meets, None without any."""
    try:
        return build_problem(given, trials, [], window=WINDOW, contact=contact)
    except RecordingError:
        return None


def _share_of_whole(problem: Problem) -> float:
    """Share of the remaining simulations that a search over whole recordings may use: all of them,
    or half where the nominal model does not stay near the recordings. Short windows are searched
    then as well, and need the other half.
    """
    near = model_follows_recordings(problem, residuals_everywhere(problem, EMPTY))
    return 1.0 if near else _OF_WHOLE


def _stage(problem: Problem) -> str:
    """What a search of a problem works on."""
    if all(s.amid for s in problem.simulator.segments):
        return f"windows of {typical_window_length(problem):.2g} s"
    return "whole recordings"


def _found_away(
    given: ModelSetup, trials: TrialSet, contact: ContactGeoms, run: Run
) -> Hypothesis | None:
    """What explains the motion far from what the robot meets; None where it never is.

    There deviations are small, and every law can be seen along the measured motion; in contact each
    has to be simulated.
    """
    away = _posed_away(given, trials, contact)
    if away is None:
        return None
    prepared, kept = away
    run.begin("windows far from contact", prepared.problem)
    return search(prepared, kept, StepwiseSelection(prepared.problem, run)).explained.hypothesis


def _with_contact(problem: Problem, clear: Hypothesis, run: Run) -> Hypothesis:
    """What was found in the air, and what contact alone adds to that."""
    run.begin("contact effects over whole recordings", problem)
    problem.family = _CONTACT
    try:
        selected = from_start(StepwiseSelection(problem, run), clear)
    finally:
        problem.family = None
    return selected.best.hypothesis


def _once_more(found: SearchResult, run: Run) -> SearchResult:
    """What contact adds to all that was found, and what is found from there: a surface that was
    hidden behind what acts in contact as well (a late clock, a drive at its limit) stands out now.
    """
    problem, known = found.prepared.problem, found.explained.hypothesis
    more = _with_contact(problem, known, run)
    if set(more.terms) <= set(known.terms):
        return found
    return _from_there(found, more, run)


def _from_there(found: SearchResult, start: Hypothesis, run: Run) -> SearchResult:
    """What is found from a hypothesis, where that leaves less than what was found."""
    run.begin(f"{_stage(found.prepared.problem)} once more", found.prepared.problem)
    selection = StepwiseSelection(found.prepared.problem, run)
    other = search(found.prepared, found.trials, selection, start)
    found = found.with_floor_of()
    return other if other.scores_better_than(found) else found


def _by_shorter(found: SearchResult, given: ModelSetup, run: Run) -> SearchResult:
    """What is found from where windows lead in which the nominal model stays near what was
    recorded, or nearer.
    """
    window = typical_window_length(found.prepared.problem)
    while True:
        window *= 0.5
        cut, kept = build_problem(given, found.trials, [], window=window)
        near = model_follows_recordings(cut.problem, residuals_everywhere(cut.problem, EMPTY))
        if near or window <= 2.0 * SHORTEST:
            break
    run.begin(f"windows of {window:g} s", cut.problem)
    start = search(cut, kept, StepwiseSelection(cut.problem, run, _CLEAR)).explained.hypothesis
    return _from_there(found, start, run) if start.terms else found


def _windowed(
    found: SearchResult,
    cut: Prepared,
    kept: TrialSet,
    clear: Hypothesis,
    run: Run,
    notes: list[str],
    longer: Callable[[], Prepared],
) -> SearchResult:
    """What explains most: whole motions, windows of them, or whole motions by what windows found.

    Args:
        found: by whole motions.
        cut, kept: the problem in windows, and its trials.
        clear: what was found far from what the robot meets.
        run: the diagnosis.
        notes: gets how it was named.
        longer: poses the problem in windows that are longer.
    """
    other = confirm(cut, kept, found, run)
    if other is None:
        # Where nothing is met, no search begins that along the motion leaves too much.
        share_left = 1.0 if clear.terms else _CLEAR
        other = search(cut, kept, StepwiseSelection(cut.problem, run, share_left), clear)
    if other.explains_more_than(found):
        notes.append(_IN_WINDOWS)
        return replace(other, whole=found.prepared.problem)
    if other.may_improve(found):
        if found.sticks_and_slips:
            with run.budget.apart():
                whole = refit_with_full_drive(found, other, longer())
            if whole.tracks_better_than(found):
                notes.append(_AS_A_DRIVE)
                return whole
        with run.budget.apart():
            whole = refit_whole_motions(found, other)
        if whole.tracks_better_than(found):
            notes.append(_NAMED_IN_WINDOWS)
            return whole
    return found


def _half_of(trials: TrialSet) -> float:
    """Half of the longest recording that is fitted, s."""
    return 0.5 * max(float(t.time[-1] - t.time[0]) for t in trials.fit)


def _left_out_joints(
    realization: Realization, trials: tuple[Trial, ...], joints: tuple[str, ...]
) -> list[str]:
    notes = []
    for joint in realization.joints:
        if joint in joints:
            continue
        lacking = [t.path.name for t in trials if joint not in t.joints]
        if lacking and len(lacking) < len(trials):
            lack = "lacks" if len(lacking) == 1 else "lack"
            notes.append(f"joint {joint!r} is left out: {', '.join(lacking)} {lack} it")
        elif lacking:
            notes.append(
                f"joint {joint!r} is in no recording: it is simulated from the model's initial "
                "position, and its influence on the other joints is not tested"
            )
    return notes
