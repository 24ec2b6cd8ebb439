"""Read earlier and later recordings of one robot, and refuse what cannot be compared."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.effort_units import without_unscaled
from pytest_twin.diagnosis.temperature import TEMPERATURE_KEY, parse_temperatures
from pytest_twin.errors import RecordingError
from pytest_twin.estimation.roles import NOTHING_HELD_OUT
from pytest_twin.identification.effort.amounts import without_amounts
from pytest_twin.identification.effort.filtering import low_passed, resample_uniformly
from pytest_twin.identification.measured_recordings import (
    MeasuredRecording,
    read_measured,
)
from pytest_twin.identification.roles import NO_PAYLOAD, reduce_to_common_joints
from pytest_twin.realization import Realization
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial.repeated_motion import overlaps, without_repeated

FEWEST_SESSIONS = 3
"""Fewest earlier sessions that can be compared with each other."""
_PARTS = 4
"""Number of parts into which earlier recordings are cut if there are too few."""
_SAME_RATE = 1.05
"""Ratio of two sampling rates up to which they are the same."""
_BELOW_NYQUIST = 0.4
"""Cutoff before a recording gets a lower rate, relative to that rate."""
_DAY = 10
"""Number of characters of a date without its time: 2026-05-03."""


@dataclass(frozen=True)
class Compared:
    """Recordings to compare, with the same joints.

    Attributes:
        before, new, held_out: earlier recordings, later ones, and later ones for the test.
        notes: one line each.
    """

    before: tuple[MeasuredRecording, ...]
    new: tuple[MeasuredRecording, ...]
    held_out: tuple[MeasuredRecording, ...]
    notes: tuple[str, ...]

    @property
    def every(self) -> tuple[MeasuredRecording, ...]:
        """All of them, in this order."""
        return (*self.before, *self.new, *self.held_out)


def has_efforts(recordings: Iterable[MeasuredRecording]) -> bool:
    """Whether every recording has a usable effort of some joint."""
    return all(bool(np.isfinite(one.effort).any()) for one in recordings)


def refuse_without_commands(compared: Compared) -> None:
    """Refuse recordings that can be compared neither by effort nor by simulation.

    Raises:
        RecordingError: a recording has no measured effort and no commands.
    """
    for recording in compared.every:
        if recording.command is None and not has_efforts([recording]):
            raise RecordingError(
                "no measured effort of a joint, and no commands to simulate",
                path=recording.path,
                where="effort",
                expected="measured efforts in the earlier and the new recordings, or commands in "
                "all of them",
            )


def read_compared(
    realization: Realization,
    before: Sequence[Path],
    new: Sequence[Path],
    held_out: Sequence[Path],
    topics: Mapping[str, str],
    options: RecordingOptions,
) -> Compared:
    """Read all recordings; roles in their metadata are ignored.

    Raises:
        RecordingError: a recording is among the earlier and the later ones, or without efforts a
            payload that changed is not declared.
        TwinError: a recording cannot be read.
    """
    notes: list[str] = []
    read_before, read_new, read_held_out = (
        [
            one
            for path in dict.fromkeys(paths)
            for one in read_measured(path, realization, topics, options, options.signals)
        ]
        for paths in (before, new, held_out)
    )
    groups = [
        without_repeated(read_before, [], notes)[0],
        *without_repeated(read_new, read_held_out, notes),
    ]
    if read_held_out and not groups[2]:
        notes.append(NOTHING_HELD_OUT)
    for one in (*groups[0], *groups[1], *groups[2]):
        if one.base is not None:
            raise RecordingError(
                "the base of the robot moves; --before compares robots with a fixed base",
                path=one.path,
                where="pose of the base",
                expected="recordings of a robot with its base fixed to the ground or to a rig",
            )
    later = [*groups[1], *groups[2]]
    _refuse_copies(groups[0], later)
    if has_efforts([*groups[0], *later]):
        notes += undeclared_payload_notes(realization, groups[0], later)
    else:
        refuse_undeclared_payloads(realization, groups[0], later)
    notes += temperature_notes(groups[0], groups[1])
    read = reduce_to_common_joints(groups[0], later, notes)
    read = without_amounts(realization, read)
    known = without_unscaled([*read.fit, *read.held_out])
    read = replace(read, fit=tuple(known[: len(read.fit)]), held_out=tuple(known[len(read.fit) :]))
    notes += list(dict.fromkeys(n for one in (*read.fit, *read.held_out) for n in one.notes))
    count = len(groups[1])
    return _with_common_efforts(
        Compared(
            read.fit, read.held_out[:count], read.held_out[count:], tuple(dict.fromkeys(notes))
        )
    )


def _refuse_copies(before: Sequence[MeasuredRecording], later: Sequence[MeasuredRecording]) -> None:
    """Refuse later recordings with a part of an earlier one: it would show that nothing changed.

    Raises:
        RecordingError: measurements of ``later`` are those of ``before``.
    """
    for one in later:
        for same in before:
            if overlaps(one, same):
                raise RecordingError(
                    f"the same recording is given with --before, as {same.path.name}",
                    path=one.path,
                    expected="other recordings before and after the change",
                )


class Described(Protocol):
    """A recording with its metadata."""

    @property
    def path(self) -> Path:
        """Its file or folder."""

    @property
    def metadata(self) -> Mapping[str, str]:
        """The record ``trial``."""


def refuse_undeclared_payloads(
    realization: Realization, before: Sequence[Described], later: Sequence[Described]
) -> None:
    """Refuse payloads that differ and whose mass the twin does not state.

    Raises:
        RecordingError: a payload of ``later`` differs and is not declared.
    """
    stated = stated_payloads(realization)
    earlier = {_unknown_payload(one, stated) for one in before}
    for one in later:
        if earlier != {_unknown_payload(one, stated)}:
            raise RecordingError(
                "its payload differs from that of the earlier recordings, and a payload is not "
                "declared: its weight would be taken for a change of the robot",
                path=one.path,
                where="metadata 'trial': payload",
                value=one.metadata.get("payload", "none"),
                expected="payloads: in twin.yaml with the mass of every payload",
            )


def undeclared_payload_notes(
    realization: Realization, before: Sequence[Described], later: Sequence[Described]
) -> list[str]:
    """A line if payloads differ whose mass the twin does not state: efforts show their mass."""
    stated = stated_payloads(realization)
    names = [
        sorted({_unknown_payload(one, stated) or "none" for one in group})
        for group in (before, later)
    ]
    if names[0] == names[1]:
        return []
    return [
        f"payload {', '.join(names[0])} before, {', '.join(names[1])} now, without a mass in "
        "twin.yaml: it is estimated as a change"
    ]


def stated_payloads(realization: Realization) -> Collection[str]:
    """Payloads whose mass the twin states."""
    return () if realization.twin is None else realization.twin.payloads


def _unknown_payload(one: Described, stated: Collection[str]) -> str:
    """Name of a payload without a stated mass; empty without one."""
    payload = one.metadata.get("payload", "")
    return "" if payload.lower() in NO_PAYLOAD or payload in stated else payload


def temperature_notes(before: Sequence[Described], new: Sequence[Described]) -> list[str]:
    """A line if the new recordings are warmer or colder than the earlier ones."""
    stated = [
        [t for one in recordings if (t := one.metadata.get(TEMPERATURE_KEY))]
        for recordings in (before, new)
    ]
    known = parse_temperatures([*stated[0], *stated[1]])
    if not stated[0] or not stated[1] or known is None:
        return []
    old, now = ([known[t] for t in names] for names in stated)
    if min(old) <= min(now) and max(now) <= max(old):
        return []
    return [
        f"declared: the temperature is {min(now):g} to {max(now):g} in the new recordings and "
        f"{min(old):g} to {max(old):g} in the earlier ones; friction changes with it"
    ]


def _with_common_efforts(read: Compared) -> Compared:
    """Leave out efforts of joints that some recording does not measure."""
    known = np.all([np.isfinite(one.effort).all(axis=0) for one in read.every], axis=0)
    if known.all():
        return read
    joints = read.before[0].joints
    lost = [joint for joint, use in zip(joints, known, strict=True) if not use]

    def left(one: MeasuredRecording) -> MeasuredRecording:
        return replace(one, effort=np.where(known, one.effort, np.nan))

    return Compared(
        tuple(left(one) for one in read.before),
        tuple(left(one) for one in read.new),
        tuple(left(one) for one in read.held_out),
        (*read.notes, f"without a measured effort in every recording: {', '.join(lost)}"),
    )


def sessions_of(recordings: Sequence[Described]) -> tuple[list[list[int]], str]:
    """Recordings of each session, and how sessions were distinguished.

    Recordings of one session share their conditions. With dates of at least three days a day is a
    session, else each recording is one.
    """
    days: dict[str, list[int]] = {}
    for i, one in enumerate(recordings):
        days.setdefault(one.metadata.get("date", "")[:_DAY], []).append(i)
    if "" not in days and len(days) >= FEWEST_SESSIONS:
        return list(days.values()), f"{len(days)} days"
    return [[i] for i in range(len(recordings))], f"{len(recordings)} recordings"


def in_parts(recordings: Sequence[MeasuredRecording]) -> list[MeasuredRecording]:
    """Recordings cut into equal parts, so that there are enough to compare."""
    parts = []
    for recording in recordings:
        for rows in np.array_split(np.arange(len(recording.time)), _PARTS):
            parts.append(part_of(recording, rows))
    return parts


def part_of(recording: MeasuredRecording, rows: NDArray[np.intp]) -> MeasuredRecording:
    """Consecutive rows of a recording, as a recording of its own."""
    return replace(
        recording,
        start=recording.start + float(recording.time[rows[0]]),
        time=recording.time[rows] - recording.time[rows[0]],
        position=recording.position[rows],
        velocity=None if recording.velocity is None else recording.velocity[rows],
        effort=recording.effort[rows],
        command=None if recording.command is None else recording.command[rows],
    )


def at_one_rate(recordings: Sequence[MeasuredRecording]) -> list[MeasuredRecording]:
    """The recordings at the rate of the slowest one, so that differentiation treats all alike."""
    slowest = min(one.rate for one in recordings)
    return [
        one if one.rate <= _SAME_RATE * slowest else _slower(one, slowest) for one in recordings
    ]


def _slower(one: MeasuredRecording, rate: float) -> MeasuredRecording:
    time = np.arange(int(one.time[-1] * rate) + 1) / rate
    even = resample_uniformly(one)

    def resampled(values: FloatArray) -> FloatArray:
        smooth = low_passed(values, _BELOW_NYQUIST * rate, even.rate)
        return np.stack([np.interp(time, even.time, column) for column in smooth.T], axis=1)

    position, effort = resampled(even.position), resampled(even.effort)
    return replace(one, time=time, position=position, effort=effort, velocity=None, command=None)
