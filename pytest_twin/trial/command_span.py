"""Cut a trial to the time in which the commands of its joints are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.recording_options import CommandMode
from pytest_twin.trial.gaps import GAP_INTERVALS, part_of
from pytest_twin.trial.trial import Trial
from pytest_twin.words import list_names

MOVES = 0.02
"""rad or m. A joint that moves less (peak to peak) rests at its setpoint."""
_LEAST_SAMPLES = 10
"""States outside the commands below which no motion is judged."""
_LATE = 0.05
"""s. A first velocity or effort that is at most this late is taken to hold from the start."""


def within_commands(trial: Trial) -> Trial:
    """Return the part of a trial in which the commands of all moving joints are known.

    A joint that rests at its first position command is taken to be held by it until then. If it
    moves, or rests elsewhere, its commands are not recorded, and the trial begins at the first one.
    So it does under velocity and effort commands, whose first value would move the joint. After its
    last command of a regular stream, a joint under position commands settles. If it still moves in
    the second half of that time, the trial ends at the last command. In other cases the last
    command holds.
    """
    if len(trial.time) < 2 * _LEAST_SAMPLES:
        return trial
    begin, end = float(trial.time[0]), float(trial.time[-1])
    notes = []
    for column, joint in enumerate(trial.command_joints):
        if joint not in trial.joints:
            continue
        times = _own_times(trial, column)
        position = trial.position[:, trial.joints.index(joint)]
        before = trial.time < times[0]
        mode = trial.command_modes[column]
        moved = _span(position[before])
        away = _away_from(position[before], trial.command[:, column], mode)
        if mode != "position" and moved <= MOVES and times[0] > begin + _LATE:
            begin = float(times[0])
            notes.append(f"the first {mode} command of {joint!r} is at {times[0]:.4g} s")
        if moved <= MOVES < away:
            begin = max(begin, float(times[0]))
            notes.append(
                f"{joint!r} rests {away:.3g} rad or m away from its first command, at "
                f"{times[0]:.4g} s"
            )
        if moved > MOVES:
            begin = max(begin, float(times[0]))
            notes.append(
                f"{joint!r} moves by {moved:.3g} rad or m before its first command at "
                f"{times[0]:.4g} s"
            )
        after = trial.time > 0.5 * (times[-1] + trial.time[-1])
        moved = _span(position[after])
        stopped = _is_stream(times, float(trial.time[-1]))
        if stopped and moved > MOVES and mode == "position":
            end = min(end, float(times[-1]))
            notes.append(
                f"{joint!r} still moves by {moved:.3g} rad or m long after its last command at "
                f"{times[-1]:.4g} s"
            )
    if not notes:
        return trial
    inside = (trial.time >= begin) & (trial.time <= end)
    why = "; ".join(notes)
    if inside.sum() < _LEAST_SAMPLES:
        return replace(trial, notes=(*trial.notes, f"{why}: the commands there are not recorded"))
    cut = part_of(trial, begin, end, -np.inf, np.inf, trial.parts)
    note = f"used from {begin:.4g} to {end:.4g} s: {why}, so that commands are not recorded there"
    return replace(cut, notes=(note, *trial.notes))


def _own_times(trial: Trial, column: int) -> FloatArray:
    """(k,) times of the messages that command one joint, s."""
    if trial.own_commands is None:
        return trial.command_time
    times: FloatArray = trial.command_time[trial.own_commands[:, column]]
    return times


def _span(position: FloatArray) -> float:
    measured = position[np.isfinite(position)]
    return float(np.ptp(measured)) if len(measured) >= _LEAST_SAMPLES else 0.0


def _away_from(position: FloatArray, command: FloatArray, mode: CommandMode) -> float:
    """Distance of a resting joint from its first position command, rad or m; 0 if not known."""
    measured = position[np.isfinite(position)]
    if mode != "position" or len(measured) < _LEAST_SAMPLES:
        return 0.0
    return abs(float(np.median(measured)) - float(command[0]))


def _is_stream(times: FloatArray, end: float) -> bool:
    """Whether commands came regularly, and stopped long before ``end`` (s)."""
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) >= _LEAST_SAMPLES else 0.0
    return (
        0.0 < GAP_INTERVALS * usual < end - float(times[-1])
        and not (steps > GAP_INTERVALS * usual).any()
    )


@dataclass(frozen=True, slots=True)
class OtherMode:
    """A time in which a joint is commanded in another field, because its controller changed.

    Attributes:
        used, other: the field that is used, and the one that is filled in that time.
        start, end: first message with the other field, and the next one with the used field, s
            from the first state; infinite if there is none.
    """

    joint: str
    used: CommandMode
    other: CommandMode
    start: float
    end: float


def other_modes(
    joint: str,
    used: CommandMode,
    time: FloatArray,
    own: NDArray[np.bool_],
    others: Mapping[CommandMode, NDArray[np.bool_]],
) -> list[OtherMode]:
    """Times in which messages command a joint in another field than the used one.

    Fields that alternate from message to message are not a change of the controller.

    Args:
        time: (n,) times of the messages, s, not decreasing.
        own: (n,) which messages have the used field.
        others: field -> (n,) which messages have it.
    """
    modes = []
    for other, filled in others.items():
        rows = np.flatnonzero(own | filled)
        is_other = (filled & ~own)[rows]
        edges = np.flatnonzero(np.diff(is_other.astype(np.int8), prepend=0, append=0))
        runs = edges.reshape(-1, 2)
        if not len(runs) or np.diff(runs, axis=1).min() < _LEAST_SAMPLES:
            continue
        for first, after in runs.tolist():
            end = float(time[rows[after]]) if after < len(rows) else np.inf
            modes.append(OtherMode(joint, used, other, float(time[rows[first]]), end))
    return modes


def without_other_modes(trial: Trial, found: Sequence[OtherMode]) -> list[Trial]:
    """Parts of a trial in which every joint is commanded in the field that is used."""
    if not found:
        return [trial]
    starts, ends, begin = [], [], -np.inf
    for one in sorted(found, key=lambda one: one.start):
        if one.start > begin:
            starts.append(begin)
            ends.append(one.start)
        begin = max(begin, one.end)
    if begin < np.inf:
        starts.append(begin)
        ends.append(np.inf)
    windows = [
        (start, end)
        for start, end in zip(starts, ends, strict=True)
        if ((trial.time >= start) & (trial.time < end)).sum() >= _LEAST_SAMPLES
        and ((trial.command_time >= start) & (trial.command_time < end)).any()
    ]
    first = found[0]
    change = (
        f"the commands of {list_names([*dict.fromkeys(one.joint for one in found)])} change from "
        f"{first.used} to {first.other} at {first.start:.4g} s, as if another controller took over"
    )
    if not windows:
        return [replace(trial, notes=(f"{change}; only {first.used} is used", *trial.notes))]
    shown = ", ".join(
        f"{max(start, 0.0):.4g} to {min(end, trial.duration):.4g} s" for start, end in windows
    )
    note = f"{change}: used are the parts with {first.used} commands, {shown}"
    parts = [
        replace(
            part_of(trial, start, np.nextafter(end, -np.inf), start, end, len(windows)), notes=()
        )
        for start, end in windows
    ]
    return [replace(parts[0], notes=(note, *trial.notes)), *parts[1:]]
