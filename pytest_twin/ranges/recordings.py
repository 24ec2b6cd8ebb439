"""Read the recordings that check or widen ranges and were not used for fitting."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.errors import RecordingError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.realization import Realization
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.records.basis import Basis
from pytest_twin.trial import Trial, make_trials, recordings_at
from pytest_twin.trial.repeated_motion import repeats_motion
from pytest_twin.trial.roles import FINAL, FIT, HELD_OUT
from pytest_twin.twin import Twin

FOLDER = "recordings"
"""Default folder of recordings in a twin's folder."""
_FEWEST = 8
"""Smallest number of samples of a trace."""
_SHORTEST_S = 0.2
"""Smallest duration of a trace."""
_HELD_OUT_TOO = "it is held out too, and may widen the ranges"


@dataclass(frozen=True)
class RecordingsByRole:
    """Recordings by role.

    Attributes:
        final: segments of recordings that check the ranges.
        held_out: segments of recordings that may widen them.
        notes: messages on what was left out.
    """

    final: tuple[Trial, ...]
    held_out: tuple[Trial, ...]
    notes: tuple[str, ...]


def read_check_recordings(
    twin: Twin,
    realization: Realization,
    final: Sequence[Path],
    held_out: Sequence[Path],
    options: RecordingOptions,
    topics: Mapping[str, str],
) -> RecordingsByRole:
    """Read the final and the held-out recordings of a twin.

    Explicitly named recordings are used; else those named in ``ranges:`` of ``twin.yaml``; else
    those in the folder ``recordings/`` next to it with the role in their metadata.

    Args:
        twin: twin whose records name their source files.
        final, held_out: recordings named by the user.
        options: settings for reading recordings.
        topics: role of a topic -> topic.

    Raises:
        RecordingError: a final recording was used for a record, is held out, has another role, or
            repeats the motion of one that was used.
        TwinError: a recording cannot be read.
    """
    notes: list[str] = []
    named = {
        FINAL: list(final or twin.ranges.final),
        HELD_OUT: list(held_out or twin.ranges.held_out),
    }
    found: dict[str, list[Trial]] = {FINAL: [], HELD_OUT: []}
    for role, paths in named.items():
        for path in paths:
            trials = _trials(path, realization, options, topics, notes)
            _check_role(trials, role, notes)
            found[role] += trials
    for path in _files_next_to(twin):
        if all(named.values()):
            break
        for trial in _trials(path, realization, options, topics, notes):
            role = trial.metadata.get("role", "")
            if role in found and not named[role]:
                found[role].append(trial)
    _refuse_used(found[FINAL], found[HELD_OUT], twin)
    if found[FINAL]:
        fitted = _fitted_trials(twin, realization, options, topics, notes)
        held = ((_HELD_OUT_TOO, trial) for trial in found[HELD_OUT])
        _refuse_repeated(found[FINAL], (*fitted, *held))
    return RecordingsByRole(
        tuple(found[FINAL]), tuple(found[HELD_OUT]), tuple(dict.fromkeys(notes))
    )


def _files_next_to(twin: Twin) -> list[Path]:
    folder = twin.root / FOLDER
    return sorted(folder.glob("*.mcap")) if folder.is_dir() else []


def _trials(
    path: Path,
    realization: Realization,
    options: RecordingOptions,
    topics: Mapping[str, str],
    notes: list[str],
) -> list[Trial]:
    found = []
    for recording in recordings_at(path, topics, options):
        for trial in make_trials(recording, realization.structure, options):
            if len(trial.time) < _FEWEST or trial.duration < _SHORTEST_S:
                notes.append(
                    f"left out: {trial.name}: {len(trial.time)} states over {trial.duration:.2g} s "
                    "show nothing"
                )
                continue
            notes += [f"{path.name}: {note}" for note in trial.notes]
            found.append(_dense(trial))
    return found


def _dense(trial: Trial) -> Trial:
    """Interpolate positions so that every stamp has all joints."""
    if trial.is_dense:
        return trial
    position = trial.position.copy()
    for column in position.T:
        known = np.isfinite(column)
        column[:] = np.interp(trial.time, trial.time[known], column[known])
    return replace(trial, position=position)


def _check_role(trials: Iterable[Trial], role: str, notes: list[str]) -> None:
    """Check that the role in the metadata is compatible with the role given by the user."""
    for trial in trials:
        own = trial.metadata.get("role")
        if own in (None, role):
            continue
        if own == FINAL or (role == FINAL and own == FIT):
            raise RecordingError(
                f"its own metadata give it another role than {role!r}",
                path=trial.path,
                where="metadata 'trial': role",
                value=own,
                expected=f"{role}, or no role",
            )
        notes.append(
            f"{trial.path.name} counts as {role}, as it is named; its metadata say {own!r}, and no "
            "record of this twin may have been made from it"
        )


def _refuse_used(final: Sequence[Trial], held_out: Sequence[Trial], twin: Twin) -> None:
    """Refuse final recordings that a record was made from, by their digests."""
    made_from = [
        *((entry.record.id, entry.record.inputs) for entry in twin.calibrations),
        *((record.id, record.inputs) for record in _identifications(twin)),
    ]
    used = {
        sha256: f"{ident!r} was made from it ({name})"
        for ident, inputs in made_from
        for name, sha256 in inputs.items()
    }
    for trial in held_out:
        if trial.path.is_file():
            used.setdefault(file_sha256(trial.path), _HELD_OUT_TOO)
    for path in dict.fromkeys(trial.path for trial in final):
        why = used.get(file_sha256(path)) if path.is_file() else None
        if why is not None:
            raise _used_before(path, why)


def _refuse_repeated(final: Sequence[Trial], used: Iterable[tuple[str, Trial]]) -> None:
    """Refuse final recordings whose motion is in a recording that was used, under another name.

    Args:
        used: why a recording is used, and its trial.
    """
    for why, other in used:
        for trial in final:
            if repeats_motion(trial, other):
                raise _used_before(
                    trial.path, f"its measured motion is that of {other.path.name}; {why}"
                )


def _used_before(path: Path, why: str) -> RecordingError:
    return RecordingError(
        f"a final recording that was used before: {why}",
        path=path,
        expected="recordings that no fit, calibration, or range was made from",
    )


def _identifications(twin: Twin) -> list[IdentificationRecord]:
    return [
        *(fit.record for fit in twin.fits),
        *(group.record for group in twin.ranges.trials),
    ]


def _fitted_trials(
    twin: Twin, realization: Realization, options: RecordingOptions, topics: Mapping[str, str],
    notes: list[str],
) -> Iterator[tuple[str, Trial]]:  # fmt: skip
    """Trials of the recordings that identifications were made from, where they are still there."""
    for record in _identifications(twin):
        if record.basis is None:
            continue
        for name, (file, _) in Basis.from_json(record.basis, record.path).files.items():
            path = (record.path.parent / file).resolve()
            if not path.exists():
                notes.append(
                    f"{name}, which {record.id!r} was made from, is not there: whether a final "
                    "recording repeats its motion is not known"
                )
                continue
            for trial in _trials(path, realization, options, topics, []):
                yield f"{record.id!r} was made from it", trial
