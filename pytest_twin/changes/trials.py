"""Earlier and later recordings of one robot that are compared by simulation."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.changes.recordings import refuse_undeclared_payloads, temperature_notes
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.unit_check import drop_other_units
from pytest_twin.errors import RecordingError
from pytest_twin.realization import Realization
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.replay_order import refuse_other_order
from pytest_twin.trial import Trial
from pytest_twin.trial.command_field import refuse_unfit_modes


@dataclass(frozen=True, slots=True)
class ComparedTrials:
    """Recordings to compare by simulation, without efforts.

    Attributes:
        before: the earlier recordings; all of them are fitted.
        new: the later ones, and those that test a change.
        notes: one line each.
    """

    before: TrialSet
    new: TrialSet
    notes: tuple[str, ...]


def read_compared_trials(
    realization: Realization,
    before: Sequence[Path],
    new: Sequence[Path],
    held_out: Sequence[Path],
    topics: Mapping[str, str],
    options: RecordingOptions,
) -> ComparedTrials:
    """Read all recordings; roles in their metadata are ignored.

    Raises:
        RecordingError: a recording is among the earlier and the later ones, the base moves, a
            payload that changed is not declared, or the commands have other fields.
        TwinError: a recording cannot be read.
    """
    structure, notes = realization.structure, list[str]()
    old, _ = _read(read_trials(before, [], topics, structure, options), realization, notes)
    later, tests = _read(
        read_trials(new, held_out, topics, structure, options), realization, notes,
        has_tests=bool(held_out),
    )  # fmt: skip
    _refuse_copies(old, (*later, *tests))
    refuse_undeclared_payloads(realization, old, [*later, *tests])
    notes += temperature_notes(old, later)
    for trial in (*later, *tests):
        if trial.command_mode != old[0].command_mode:
            raise RecordingError(
                "its commands have another field than those of the earlier recordings",
                path=trial.path,
                where="commands",
                value=trial.command_mode,
                expected=old[0].command_mode,
            )
    return ComparedTrials(
        TrialSet(old, (), ()), TrialSet(later, tests, ()), tuple(dict.fromkeys(notes))
    )


def _read(
    read: TrialSet, realization: Realization, notes: list[str], *, has_tests: bool = False
) -> tuple[tuple[Trial, ...], tuple[Trial, ...]]:
    """Recordings to compare and test recordings, without efforts and without copies."""
    read = drop_other_units(realization, read, notes)
    notes += [note for note in read.notes if note.startswith("left out: ")]
    # Without --held-out a role only says how a diagnosis would have used the recording.
    fit = read.fit if has_tests else (*read.fit, *read.held_out)
    kept = dict[str, Trial]()
    for trial in sorted(fit, key=lambda t: (str(t.path), t.offset)):
        if trial.base is not None:
            raise RecordingError(
                "the base of the robot moves; --before compares robots with a fixed base",
                path=trial.path,
                where="pose of the base",
                expected="recordings of a robot with its base fixed to the ground or to a rig",
            )
        refuse_unfit_modes(realization.structure, trial)
        first = kept.setdefault(_content(trial), trial)
        if first is not trial:
            notes.append(f"left out: {trial.path.name} has the content of {first.path.name}")
    refuse_other_order(realization, list(kept.values()))
    return tuple(
        tuple(replace(trial, effort=None) for trial in trials)
        for trials in (kept.values(), read.held_out if has_tests else ())
    )  # type: ignore[return-value]


def _content(trial: Trial) -> str:
    """Key of what was measured, whatever the file is called and however it is stored."""
    return hashlib.sha256(np.round(np.nan_to_num(trial.position), 9).tobytes()).hexdigest()


def _refuse_copies(before: Sequence[Trial], later: Sequence[Trial]) -> None:
    known = {_content(trial): trial for trial in before}
    for trial in later:
        if (same := known.get(_content(trial))) is not None:
            raise RecordingError(
                f"the same recording is given with --before, as {same.path.name}",
                path=trial.path,
                expected="other recordings before and after the change",
            )
