"""A diagnosis from recordings to findings and the unexplained residual."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.coarse_step import coarse_step
from pytest_twin.diagnosis.cost import Cost, cost
from pytest_twin.diagnosis.creep import CREEPS, found_so, posed, searched_so
from pytest_twin.diagnosis.findings import Explained, by_whole_motions, finding_json
from pytest_twin.diagnosis.given import Given
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis
from pytest_twin.diagnosis.other_unit import without_other_units
from pytest_twin.diagnosis.patched.model import Patched
from pytest_twin.diagnosis.prepare import Prepared
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.rivals import Selected
from pytest_twin.diagnosis.search.select import Selection
from pytest_twin.diagnosis.searched import (
    Searched,
    carried,
    confirmed,
    from_start,
    left_everywhere,
    pose,
    search,
    with_drive_of,
)
from pytest_twin.diagnosis.shorter import SHORTEST, stays_near, usual_length
from pytest_twin.diagnosis.simulated import (
    explains_more,
    simulated_in_words,
    simulated_so,
    stepped_otherwise,
)
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.unexplained import Left, unexplained
from pytest_twin.diagnosis.verdict import JointError, Verdict
from pytest_twin.diagnosis.windows import WINDOW
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.errors import RecordingError
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial

# Share of the squared mismatch that may be left along the motion where a law of the catalogue is
# worth a search in windows.
_CLEAR = 0.1
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
        prepared, selected, trials: problem, model selection and recordings behind the result.
        before, after: (samples, signals) residuals over all segments.
        cost: computing time.
    """

    verdict: Verdict
    explained: Explained
    errors: Mapping[str, JointError]
    left: Mapping[str, Left]
    notes: tuple[str, ...]
    prepared: Prepared
    selected: Selected
    trials: TrialSet
    before: FloatArray
    after: FloatArray
    cost: Cost

    @property
    def has_held_out(self) -> bool:
        """Whether any recording was held out."""
        return bool(len(self.prepared.problem.held_out))

    def to_json(self, *, realization: str) -> dict[str, Any]:
        """``diagnosis.json``, schema 1."""
        return {
            "schema": 1,
            "verdict": self.verdict,
            "findings": [finding_json(f) for f in self.explained.findings],
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
                source: dict(zip(self.prepared.problem.joints, map(float, rms), strict=True))
                for source, rms in self.prepared.floor_parts.items()
            },
            "unexplained": {
                joint: {
                    "fraction": round(item.fraction, 5),
                    "where": item.where.summary,
                    "windows": dict(item.where.windows),
                }
                for joint, item in self.left.items()
            },
            "realization": realization,
            "trials": {
                "fit": list(dict.fromkeys(t.path.name for t in self.trials.fit)),
                "held_out": list(dict.fromkeys(t.path.name for t in self.trials.held_out)),
            },
            "notes": list(self.notes),
            "cost": self.cost.to_json(),
        }


def diagnose(
    realization: Realization,
    trials: TrialSet,
    *,
    inherited: Patched | None = None,
    threads: int = 0,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Diagnosis:
    """Diagnose a model: locate errors, identify effects, fit them, and test them.

    Args:
        realization: the nominal model.
        trials: the recordings.
        inherited: effects of an earlier diagnosis that the MJCF of ``realization`` cannot hold.
        threads: threads of batch simulations, 0 for all cores.
        progress: called with the fraction done.

    Raises:
        RecordingError: model and recordings share no joint, or angles are not in rad.
        SpecError: a controller, payload or actuator is missing in the model.
    """
    since = time.perf_counter()
    notes = list(trials.notes)
    given = Given.of(realization, inherited, threads)
    progress(0.02)
    trials = without_other_units(realization, trials, notes)
    given, prepared, trials = posed(given, trials, notes)
    everything = (*trials.fit, *trials.held_out)
    notes += _left_out_joints(realization, everything, prepared.problem.joints)
    progress(0.06)
    steps = 0

    def say(text: str) -> None:
        nonlocal steps
        del text
        steps += 1
        # The number of rounds is unknown: each one advances by a fixed part of the remainder.
        progress(0.06 + 0.74 * (1.0 - 0.95**steps))

    # Diverging candidates overflow; values that are not finite are ranked last.
    problems: list[Problem] = []
    with np.errstate(over="ignore", invalid="ignore"):
        given, prepared, trials = simulated_so(given, prepared, trials, problems)
        sought = _sought(given, prepared, trials, problems, say)
        given, found = sought.given, sought.found
        notes += sought.notes
        left = {}
        if found.verdict in ("improved", "unexplained"):
            left = unexplained(found, *sought.near)
    progress(0.9)
    if given.creeps:
        notes.append(CREEPS)
    if given.substeps:
        notes.append(simulated_in_words(found.prepared))
    notes += found.explained.notes
    notes += coarse_step(found.prepared.problem, found.explained.hypothesis, found.errors)
    if not len(prepared.problem.held_out):
        notes.append(
            "no recording was held out: errors and gains are those of the fitted recordings"
        )
    progress(0.94)
    return Diagnosis(
        found.verdict, found.explained, found.errors, left, tuple(notes), found.prepared,
        found.selected, found.trials, found.before, found.after, cost(problems, since),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Sought:
    """What was found, how the model was stepped for it, the problem that says where the rest is,
    and what a reader has to know.
    """

    given: Given
    found: Searched
    near: tuple[Prepared, TrialSet]
    notes: tuple[str, ...]


def _sought(
    given: Given,
    prepared: Prepared,
    trials: TrialSet,
    problems: list[Problem],
    say: Callable[[str], None],
) -> _Sought:
    """Search whole motions, and windows of them where these tell more.

    Args:
        given: the model, and how it is stepped.
        prepared, trials: its problem over whole motions.
        problems: gets every problem that was searched.
        say: told what is considered.
    """
    notes: list[str] = []
    problems.append(prepared.problem)
    contact = prepared.problem.simulator.models.contact
    clear, start = EMPTY, EMPTY
    if contact.world.size:
        away = _posed_away(given, trials, contact)
        if away is not None:
            problems.append(away[0].problem)
            clear = _found_away(*away, say)
            start = _with_contact(prepared.problem, clear, say)
    given, found = searched_so(given, prepared, trials, problems, say, start)
    if found.astray and contact.world.size:
        found = _once_more(found, say)
    elif found.far_from and not contact.world.size:
        found = _by_shorter(found, given, problems, say)
    given, found = found_so(found, given, problems, say)
    stepped = stepped_otherwise(found, given)
    if stepped is not None:
        other = _sought(stepped, *pose(stepped, found.trials, []), problems, say)
        if explains_more(other.found, found):
            return other
    near = found.prepared, found.trials
    if found.astray and (clear.terms or not contact.world.size):
        near = pose(given, trials, [], window=WINDOW)
        problems.append(near[0].problem)
        if contact.world.size:
            # What acts in the air is known from there.
            near[0].problem.family = _CONTACT

        def longer() -> Prepared:
            cut, _ = pose(given, trials, [], window=_half_of(trials))
            problems.append(cut.problem)
            return cut

        found = _windowed(found, *near, clear, say, notes, longer)
    return _Sought(given, found, near, tuple(notes))


def _posed_away(
    given: Given, trials: TrialSet, contact: ContactGeoms
) -> tuple[Prepared, TrialSet] | None:
    """The problem in windows that are far from what the robot meets, None without any."""
    try:
        return pose(given, trials, [], window=WINDOW, contact=contact)
    except RecordingError:
        return None


def _found_away(prepared: Prepared, trials: TrialSet, say: Callable[[str], None]) -> Hypothesis:
    """What explains the motion far from what the robot meets.

    There deviations are small, and every law can be seen along the measured motion; in contact each
    has to be simulated.
    """
    return search(prepared, trials, Selection(prepared.problem, say)).explained.hypothesis


def _with_contact(problem: Problem, clear: Hypothesis, say: Callable[[str], None]) -> Hypothesis:
    """What was found in the air, and what contact alone adds to that."""
    problem.family = _CONTACT
    selected = from_start(Selection(problem, say), clear)
    problem.family = None
    return selected.best.hypothesis


def _once_more(found: Searched, say: Callable[[str], None]) -> Searched:
    """What contact adds to all that was found, and what is found from there: a surface that was
    hidden behind what acts in contact as well (a late clock, a drive at its limit) stands out now.
    """
    problem, known = found.prepared.problem, found.explained.hypothesis
    more = _with_contact(problem, known, say)
    if set(more.terms) <= set(known.terms):
        return found
    return _from_there(found, more, say)


def _from_there(found: Searched, start: Hypothesis, say: Callable[[str], None]) -> Searched:
    """What is found from a hypothesis, where that leaves less than what was found."""
    selection = Selection(found.prepared.problem, say)
    other = search(found.prepared, found.trials, selection, start)
    found = found.judged_again()
    return other if other.leaves_less(found) else found


def _by_shorter(
    found: Searched, given: Given, problems: list[Problem], say: Callable[[str], None]
) -> Searched:
    """What is found from where windows lead in which the model as it came stays near what was
    recorded, or nearer.
    """
    window = usual_length(found.prepared.problem)
    while True:
        window *= 0.5
        cut, kept = pose(given, found.trials, [], window=window)
        near = stays_near(cut.problem, left_everywhere(cut.problem, EMPTY))
        if near or window <= 2.0 * SHORTEST:
            break
    problems.append(cut.problem)
    start = search(cut, kept, Selection(cut.problem, say, _CLEAR)).explained.hypothesis
    return _from_there(found, start, say) if start.terms else found


def _windowed(
    found: Searched,
    cut: Prepared,
    kept: TrialSet,
    clear: Hypothesis,
    say: Callable[[str], None],
    notes: list[str],
    longer: Callable[[], Prepared],
) -> Searched:
    """What explains most: whole motions, windows of them, or whole motions by what windows found.

    Args:
        found: by whole motions.
        cut, kept: the problem in windows, and its trials.
        clear: what was found far from what the robot meets.
        say: told what is considered.
        notes: gets how it was named.
        longer: poses the problem in windows that are longer.
    """
    other = confirmed(cut, kept, found, say)
    if other is None:
        # Where nothing is met, no search begins that along the motion leaves too much.
        share_left = 1.0 if clear.terms else _CLEAR
        other = search(cut, kept, Selection(cut.problem, say, share_left), clear)
    if other.supersedes(found):
        notes.append(_IN_WINDOWS)
        return replace(other, explained=by_whole_motions(other.explained, found.prepared.problem))
    if other.beside(found):
        if found.slips:
            whole = with_drive_of(found, other, longer())
            if whole.follows_better(found):
                notes.append(_AS_A_DRIVE)
                return whole
        whole = carried(found, other)
        if whole.follows_better(found):
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
