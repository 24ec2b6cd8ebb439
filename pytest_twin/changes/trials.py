"""Earlier and later recordings of one robot that are compared by simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

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
        RecordingError: the base moves, a payload that changed is not declared, or the commands
            have other fields.
        TwinError: a recording cannot be read.
    """
    structure, notes = realization.structure, list[str]()
    old, _ = _read(read_trials(before, [], topics, structure, options), realization, notes)
    later, tests = _read(
        read_trials(new, held_out, topics, structure, options), realization, notes,
        has_tests=bool(held_out),
    )  # fmt: skip
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
    """Recordings to compare and test recordings, without efforts."""
    read = drop_other_units(realization, read, notes)
    notes += [note for note in read.notes if note.startswith("left out: ")]
    # Without --held-out a role only says how a diagnosis would have used the recording.
    fit = read.fit if has_tests else (*read.fit, *read.held_out)
    fit = tuple(sorted(fit, key=lambda t: (str(t.path), t.offset)))
    for trial in fit:
        if trial.base is not None:
            raise RecordingError(
                "the base of the robot moves; --before compares robots with a fixed base",
                path=trial.path,
                where="pose of the base",
                expected="recordings of a robot with its base fixed to the ground or to a rig",
            )
        refuse_unfit_modes(realization.structure, trial)
    refuse_other_order(realization, list(fit))
    return tuple(
        tuple(replace(trial, effort=None) for trial in trials)
        for trials in (fit, read.held_out if has_tests else ())
    )  # type: ignore[return-value]
