"""The searches of one diagnosis: over whole recordings, over windows, with and without contact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from pytest_twin.diagnosis.alternative_sets import compare_with_other_sets, without_comparison
from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.friction_constraint import (
    refit_with_better_constraint,
    search_with_better_constraint,
)
from pytest_twin.diagnosis.integrator_detection import (
    detect_integrator,
    simulation_explains_more,
)
from pytest_twin.diagnosis.integrator_of_findings import refit_with_detected_timestep
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    build_problem,
    confirm_effects,
    refit_whole_motions,
    refit_with_full_drive,
    residuals_everywhere,
    search,
)
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.window_length import (
    model_follows_recordings,
    typical_window_length,
)
from pytest_twin.diagnosis.window_settings import WINDOWS
from pytest_twin.diagnosis.windows import WINDOW
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.errors import RecordingError
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis

# Windows are searched only if some set leaves at most this share of the nominal model's squared
# error in the linearized motion.
_MAX_RESIDUAL_SHARE = 0.1
_SHARE_FOR_WHOLE_RECORDINGS = 0.5
"""Share of the simulations for whole recordings if windows are searched too."""
_CONTACT_FAMILY = "contact"
_WINDOWS_NOTE = (
    f"all errors are of predictions over windows of {WINDOW:g} s that start from measured states: "
    "over whole recordings small errors of this motion grow (an oscillating servo, a falling arm, "
    "an integrated velocity)"
)

_SELECTED_IN_WINDOWS_NOTE = (
    f"the effects were selected in windows of {WINDOW:g} s that start from measured states, and "
    "fitted over whole recordings: over whole recordings stick-slip motion separates effects less"
)

_FULL_DRIVE_NOTE = (
    "all drive parameters were fitted together, because stick-slip motion does not separate them; "
    "alternatives to the findings with 50 % confidence were not tested"
)


@dataclass(frozen=True, slots=True)
class RecordingSearchResult:
    """Result of all searches of a diagnosis.

    Attributes:
        setup: the model with the simulation settings of this result.
        location_window: length in s of the windows in which the unexplained residual is located;
            None for whole recordings.
        notes: one line each, for the reader.
    """

    setup: ModelSetup
    found: SearchResult
    location_window: float | None
    notes: tuple[str, ...]


def search_recordings(
    setup: ModelSetup, prepared: PreparedProblem, trials: TrialSet, run: Run
) -> RecordingSearchResult:
    """Search for effects over whole recordings, and over windows of them if these explain more.

    If time runs out, the result of the last finished search is returned.

    Args:
        setup: the model with its simulation settings.
        prepared, trials: the problem over whole recordings, and its trials.
    """
    notes: list[str] = []
    problem = prepared.problem
    run.budget.add(problem)
    contact = problem.simulator.models.contact
    effects_without_contact, start = EMPTY, EMPTY
    if contact.world.size:
        away = run.attempt(
            "the search for effects far from contact",
            lambda: _search_away_from_contact(setup, trials, contact, run), None,
        )  # fmt: skip
        if away is not None:
            effects_without_contact = start = away
            start = run.attempt(
                "contact effects in addition",
                lambda: _add_contact_effects(problem, effects_without_contact, run),
                effects_without_contact,
            )
    run.begin(_stage_of(problem), problem)
    with run.budget.reserved():
        share = _share_for_whole_recordings(problem)
    with run.budget.part(share):
        setup, found = search_with_better_constraint(setup, prepared, trials, run, start)
    if found.has_diverged and contact.world.size:
        found = run.attempt(
            "contact effects once more", partial(add_contact_effects_again, found, run), found
        )
    elif found.departs_from_recordings and not contact.world.size:
        found = run.attempt(
            "a search from shorter windows",
            partial(search_shorter_windows, found, setup, run),
            found,
        )
    setup, found = run.attempt(
        "another model of creep under dry friction",
        partial(refit_with_better_constraint, found, setup, run),
        (setup, found),
    )
    of_simulation = run.attempt(
        "recordings of a simulation",
        partial(_search_with_detected_integrator, found, setup, run),
        None,
    )
    if of_simulation is not None:
        return of_simulation
    with_timestep = run.attempt(
        "the integration error of a simulation",
        partial(refit_with_detected_timestep, found, setup, run),
        None,
    )
    if with_timestep is not None:
        setup, found = with_timestep
    location_window: float | None = None
    if found.has_diverged and (effects_without_contact.terms or not contact.world.size):
        location_window = WINDOW
        found, window_notes = run.attempt(
            f"windows of {WINDOW:g} s",
            partial(_search_windows, found, setup, trials, effects_without_contact, run),
            (found, list[str]()),
        )
        notes += window_notes
    return RecordingSearchResult(setup, found, location_window, tuple(notes))


def _search_with_detected_integrator(
    found: SearchResult, setup: ModelSetup, run: Run
) -> RecordingSearchResult | None:
    """Search again without correcting the integration error, if a simulation made the recordings.

    None if the recordings contain no integration error, or if that search explains no more.
    """
    changed_setup = detect_integrator(found, setup)
    if changed_setup is None:
        return None
    prepared, trials = build_problem(changed_setup, found.trials, [])
    other = search_recordings(changed_setup, prepared, trials, run)
    return other if simulation_explains_more(other.found, found) else None


def _search_windows(
    found: SearchResult,
    setup: ModelSetup,
    trials: TrialSet,
    effects_without_contact: Hypothesis,
    run: Run,
) -> tuple[SearchResult, list[str]]:
    """The better result of whole recordings and windows, with notes for the reader."""
    cut, kept = build_problem(setup, trials, [], window=WINDOW)
    run.begin(f"windows of {WINDOW:g} s", cut.problem)
    if cut.problem.simulator.models.contact.world.size:
        # Effects that act without contact are known from the windows away from it.
        cut = replace(cut, problem=replace(cut.problem, family=_CONTACT_FAMILY))

    def build_longer_windows() -> PreparedProblem:
        halves, _ = build_problem(setup, trials, [], window=_half_of_longest(trials))
        run.begin("windows of half a recording", halves.problem)
        return halves

    notes: list[str] = []
    return _compare_with_windows(
        found, cut, kept, effects_without_contact, run, notes, build_longer_windows
    ), notes


def _problem_away_from_contact(
    setup: ModelSetup, trials: TrialSet, contact: ContactGeoms
) -> tuple[PreparedProblem, TrialSet] | None:
    """The problem in windows without contact; None if there are none."""
    try:
        return build_problem(setup, trials, [], window=WINDOW, contact=contact)
    except RecordingError:
        return None


def _share_for_whole_recordings(problem: Problem) -> float:
    """Share of the remaining simulations for the search over whole recordings.

    It is one half if the nominal model departs from the recordings, because short windows are then
    searched as well.
    """
    follows = model_follows_recordings(problem, residuals_everywhere(problem, EMPTY))
    return 1.0 if follows else _SHARE_FOR_WHOLE_RECORDINGS


def _stage_of(problem: Problem) -> str:
    """Name of the stage that searches a problem."""
    if all(s.starts_in_motion for s in problem.simulator.segments):
        return f"windows of {typical_window_length(problem):.2g} s"
    return "whole recordings"


def _search_away_from_contact(
    setup: ModelSetup, trials: TrialSet, contact: ContactGeoms, run: Run
) -> Hypothesis | None:
    """Effects that explain the motion away from contact; None if the robot is always in contact.

    Away from contact the linearization is valid for every law. In contact every candidate must be
    simulated.
    """
    away = _problem_away_from_contact(setup, trials, contact)
    if away is None:
        return None
    prepared, kept = away
    run.begin("windows far from contact", prepared.problem)
    return search(prepared, kept, EffectSelection(prepared.problem, run)).explanation.hypothesis


def _add_contact_effects(
    problem: Problem, effects_without_contact: Hypothesis, run: Run
) -> Hypothesis:
    """The effects that were found away from contact, with contact effects added."""
    run.begin("contact effects over whole recordings", problem)
    of_contact = replace(problem, family=_CONTACT_FAMILY)
    return EffectSelection(of_contact, run).run(effects_without_contact).best.hypothesis


def add_contact_effects_again(found: SearchResult, run: Run) -> SearchResult:
    """Add contact effects to a result, and continue the search from it.

    The error of a surface may be hidden by other effects that act in contact as well (a late clock,
    a saturated drive).
    """
    problem, hypothesis = found.prepared.problem, found.explanation.hypothesis
    more = _add_contact_effects(problem, hypothesis, run)
    if set(more.terms) <= set(hypothesis.terms):
        return found
    return _continue_from(found, more, run)


def _continue_from(found: SearchResult, start: Hypothesis, run: Run) -> SearchResult:
    """The result of a search from a hypothesis, if it is better than the present one."""
    run.begin(f"{_stage_of(found.prepared.problem)} once more", found.prepared.problem)
    selection = EffectSelection(found.prepared.problem, run)
    other = search(found.prepared, found.trials, selection, start)
    found = found.with_floor_of(other)
    return other if other.scores_better_than(found) else found


def search_shorter_windows(found: SearchResult, setup: ModelSetup, run: Run) -> SearchResult:
    """Search in windows that the nominal model follows, then continue from that result.

    Windows are halved until the nominal model follows the recordings within each. The better one of
    the new and the present result is returned.
    """
    window = typical_window_length(found.prepared.problem)
    while True:
        window *= 0.5
        cut, kept = build_problem(setup, found.trials, [], window=window)
        follows = model_follows_recordings(cut.problem, residuals_everywhere(cut.problem, EMPTY))
        if follows or window <= 2.0 * WINDOWS.shortest:
            break
    run.begin(f"windows of {window:g} s", cut.problem)
    start = search(
        cut, kept, EffectSelection(cut.problem, run, _MAX_RESIDUAL_SHARE)
    ).explanation.hypothesis
    return _continue_from(found, start, run) if start.terms else found


def _compare_with_windows(
    found: SearchResult,
    cut: PreparedProblem,
    kept: TrialSet,
    effects_without_contact: Hypothesis,
    run: Run,
    notes: list[str],
    build_longer_windows: Callable[[], PreparedProblem],
) -> SearchResult:
    """The best result of whole recordings, windows, and whole recordings with effects of windows.

    Args:
        cut, kept: the problem in windows, and its trials.
        effects_without_contact: effects that were found away from contact.
        notes: receives how the effects were selected.
        build_longer_windows: builds the problem in longer windows.
    """
    other = confirm_effects(cut, kept, found, run)
    if other is None:
        # Without contact effects, windows are searched only if some set explains most of the error
        # in the linearized motion.
        max_residual_share = 1.0 if effects_without_contact.terms else _MAX_RESIDUAL_SHARE
        other = search(
            cut,
            kept,
            EffectSelection(cut.problem, run, max_residual_share),
            effects_without_contact,
        )
    if other.explains_more_than(found):
        notes.append(_WINDOWS_NOTE)
        return replace(other, whole=found.prepared.problem)
    if other.may_improve(found):
        # Sets of effects are not compared over whole stick-slip motions; their confidence comes
        # from the windows.
        compared = run.attempt(
            "other sets of effects instead of those of windows",
            partial(compare_with_other_sets, other, run),
            None,
        )
        other = without_comparison(other, run) if compared is None else compared[0]
        if found.has_stick_slip:
            with run.budget.uncounted():
                whole = refit_with_full_drive(found, other, build_longer_windows())
            if whole.tracks_better_than(found):
                notes.append(_FULL_DRIVE_NOTE)
                return whole
        with run.budget.uncounted():
            whole = refit_whole_motions(found, other)
        if whole.tracks_better_than(found):
            notes.append(_SELECTED_IN_WINDOWS_NOTE)
            return whole
    return found


def _half_of_longest(trials: TrialSet) -> float:
    """Half the duration of the longest fitted recording, s."""
    return 0.5 * max(float(t.time[-1] - t.time[0]) for t in trials.fit)
