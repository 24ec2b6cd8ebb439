"""Find what changed in a robot from positions: its model is simulated.

The search over the earlier recordings gives the effects that the robot had before. The model with
them is the nominal model of the later recordings. Around it, the earlier recordings measure every
law of the catalogue (ridge prior), which decides whether anything changed. What changed is searched
in the later recordings, where the residual of the earlier ones is subtracted and counts as noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.changes.background import Rows
from pytest_twin.changes.carried import carried_half_widths
from pytest_twin.changes.comparison import Comparison, compare
from pytest_twin.changes.find_changes import extrapolation_notes
from pytest_twin.changes.position_rows import PositionLaws, in_parts, position_laws
from pytest_twin.changes.recordings import FEWEST_SESSIONS, sessions_of
from pytest_twin.changes.repeated import (
    RepeatedAlarm,
    RepeatedMotion,
    is_alarm,
    least_likely,
    repeated_motions,
)
from pytest_twin.changes.trials import ComparedTrials
from pytest_twin.changes.undone import not_excluded_before
from pytest_twin.diagnosis.budget import Budget
from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.conclusion import ChosenModel, TestedModel, evaluate_on_test
from pytest_twin.diagnosis.findings import with_unexplained_share
from pytest_twin.diagnosis.first_answer import FIRST_SECONDS, first_answer
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import PatchedModel, applied_effects
from pytest_twin.diagnosis.run import Run, describe_skipped_searches
from pytest_twin.diagnosis.search_recordings import find_structure
from pytest_twin.diagnosis.signal_meaning import determine_signals
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial

_BEFORE_SHARE = 0.5
"""Share of the time limit for the earlier recordings: both searches have the same catalogue."""
_FIRST_SHARE = 0.25
"""Share of the time for the earlier recordings in which their search must have a start."""
_LEAST_SECONDS = 1e-3
"""Time that remains where the limit is over, s: 0 would be no limit."""
_PARTS = 4
"""Number of parts into which an earlier recording is cut if there are too few."""


@dataclass(frozen=True, slots=True)
class SimulatedChanges:
    """What changed between two sets of recordings, by simulation.

    Attributes:
        known: the model of the earlier recordings.
        patched: the same with its effects as effects of the nominal model.
        laws, rows, comparison: the linear comparison.
        found: effects of the later recordings in addition; None if nothing changed.
        uncertain_before: those of them that the earlier recordings do not exclude.
        carried: half width of the 95 % interval of their parameters by the earlier model, SI units.
        repeated: new recordings that repeat the motion of earlier ones.
        least_likely: the difference of these that is least likely where nothing changed.
        before, new, held_out: the recordings.
        sessions: how earlier sessions were distinguished, such as ``8 recordings``.
        is_known_complete: whether the search over the earlier recordings ended by itself.
        is_complete: whether the search for changes ended by itself.
    """

    known: ChosenModel
    patched: PatchedModel
    laws: PositionLaws
    rows: Rows
    comparison: Comparison
    found: TestedModel | None
    uncertain_before: frozenset[Term]
    carried: Mapping[Term, Mapping[str, float]]
    repeated: tuple[RepeatedMotion, ...]
    least_likely: RepeatedAlarm | None
    before: tuple[Trial, ...]
    new: tuple[Trial, ...]
    held_out: tuple[Trial, ...]
    sessions: str
    is_known_complete: bool
    is_complete: bool
    notes: tuple[str, ...]
    level: float

    @property
    def is_changed(self) -> bool:
        """Whether the score or a repeated motion is an alarm."""
        return self.comparison.is_changed or is_alarm(self.least_likely, self.level)


def find_changes_by_simulation(
    realization: Realization,
    compared: ComparedTrials,
    level: float,
    budget: Budget,
    inherited: PatchedModel | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> SimulatedChanges:
    """Compare later recordings with earlier ones by simulation.

    Args:
        level: probability of an alarm if nothing changed, such as 0.05.
        budget: limits of the whole comparison; at the limit the best answer so far is given.
        inherited: effects of an earlier diagnosis that the MJCF of ``realization`` cannot hold.
        progress: called with the fraction done, 0 to 1.

    Raises:
        RecordingError, SpecError: as :func:`~pytest_twin.diagnosis.diagnose.diagnose`.
    """
    notes = list(compared.notes)
    first = Run(_part_of(budget, _BEFORE_SHARE))
    setup = ModelSetup.of(realization, inherited)
    with first.budget.searching(0.5):
        signals = determine_signals(setup, compared.before)
    before, new = signals.apply(compared.before), signals.apply(compared.new)
    if not first.is_over:
        seconds = min(FIRST_SECONDS, _FIRST_SHARE * first.budget.left)
        seen = first_answer(realization, before.fit, inherited, seconds)
        first.first_answer = () if seen is None else seen.likely_effects
    with np.errstate(over="ignore", invalid="ignore"):
        known = find_structure(
            realization, before, inherited=inherited, run=first,
            progress=lambda fraction: progress(0.4 * fraction),
        )  # fmt: skip
        patched = _patched(known, inherited)
        laws, rows, comparison, words = _compare(realization, known, patched, new, level, notes)
        progress(0.5)
        found, repeated = None, repeated_motions(before.fit, new.fit)
        uncertain_before = frozenset[Term]()
        carried: Mapping[Term, Mapping[str, float]] = {}
        unlikely = least_likely(repeated, known.found)
        second = Run(_part_of(budget, 1.0))
        if comparison.is_changed or is_alarm(unlikely, level):
            structure = find_structure(
                realization, replace(new, held_out=(), earlier=known.found.trials.fit),
                inherited=patched, run=second,
                progress=lambda fraction: progress(0.5 + 0.4 * fraction),
            )  # fmt: skip
            found = evaluate_on_test(structure, new)
            if not new.held_out:
                # With recordings that test the changes, the evaluation does it.
                explanation = with_unexplained_share(found.explanation, found.tested.errors)
                found = replace(found, explanation=explanation)
            notes += found.notes
            changes = structure.found.prepared
            hypothesis = structure.found.explanation.hypothesis
            repeated = repeated_motions(before.fit, new.fit, structure.found)
            uncertain_before = not_excluded_before(
                structure.setup, known.found.trials.fit, changes, hypothesis
            )
            carried = carried_half_widths(
                changes.problem, hypothesis, known.found.prepared.problem, known.found.explanation
            )
    for run, which in ((first, "earlier"), (second, "new")):
        notes += [f"{which} recordings: {note}" for note in describe_skipped_searches(run)]
    return SimulatedChanges(
        known, patched, laws, rows, comparison, found, uncertain_before, carried, repeated,
        unlikely, before.fit, new.fit, new.held_out, words, not first.skipped_searches,
        not second.skipped_searches, tuple(dict.fromkeys(notes)), level,
    )  # fmt: skip


def _part_of(budget: Budget, share: float) -> Budget:
    """A share of the remaining time; no limit where the whole has none."""
    return Budget(max(share * budget.left, _LEAST_SECONDS) if budget.seconds else 0.0)


def _patched(known: ChosenModel, inherited: PatchedModel | None) -> PatchedModel:
    """The effects of the earlier recordings as effects of the nominal model."""
    problem = known.found.prepared.problem
    effects = applied_effects(known.found.explanation.hypothesis, problem.joints, problem.scales)
    outside_mjcf = () if inherited is None else inherited.effects
    return PatchedModel(
        problem.joints, (*outside_mjcf, *effects), known.found.prepared.cold_fractions,
        known.setup.has_friction_creep,
    )  # fmt: skip


def _compare(
    realization: Realization,
    known: ChosenModel,
    patched: PatchedModel,
    new: TrialSet,
    level: float,
    notes: list[str],
) -> tuple[PositionLaws, Rows, Comparison, str]:
    """The linear comparison around the model of the earlier recordings."""
    setup = replace(
        ModelSetup.of(realization, patched),
        substeps=known.setup.substeps, is_of_robot=known.setup.is_of_robot,
    )  # fmt: skip
    old, later = known.found.trials.fit, new.fit
    every = TrialSet((*old, *later), (), ())
    prepared, every = build_problem(setup, every, notes, window=known.found.prepared.window)
    laws = position_laws(prepared, every.fit)
    earlier = {id(trial) for trial in old}
    count = sum(id(trial) in earlier for trial in every.fit)
    sessions, words = sessions_of(every.fit[:count])
    if len(sessions) < FEWEST_SESSIONS:
        cut = [each for part in laws.parts[:count] for each in in_parts(part, _PARTS)]
        laws = replace(laws, parts=(*cut, *laws.parts[count:]))
        count = len(cut)
        sessions, words = [[i] for i in range(count)], f"{count} parts of recordings"
        notes.append(
            f"fewer than {FEWEST_SESSIONS} earlier recordings: they are compared in parts, which "
            "share their conditions, so alarms are more frequent than the level; record more"
        )
    rows = laws.rows(count)
    groups, _ = sessions_of([part.recording for part in laws.parts[count:]])
    comparison = compare(
        rows, sessions, [[count + i for i in group] for group in groups], laws.shapes, level,
    )  # fmt: skip
    notes += extrapolation_notes(comparison, laws.joints, level)
    return laws, rows, comparison, words


__all__: Sequence[str] = ["SimulatedChanges", "find_changes_by_simulation"]
