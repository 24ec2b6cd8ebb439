"""Find times in which a recorder lost messages, and split trials there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.trial.trial import Mark, Trial

GAP_INTERVALS = 4.0
"""Median intervals. A longer interval is a gap: at least three messages are missing."""
# Median intervals. In a topic with a regular rate, a longer interval shows one missing message.
_MISSING_INTERVALS = 1.75
# A rate is regular if this fraction of the intervals is within this fraction of the median.
_EVEN_SHARE, _EVEN = 0.9, 0.25
# Both topics stop at the same time if their stamps agree within this many median intervals.
_TOGETHER = 2.0


@dataclass(frozen=True, slots=True)
class CommonGap:
    """A time in which the recorder lost the messages of both topics.

    Attributes:
        start, end: stamps of the last state before it and the first after it, s.
        command_start, command_end: stamps of the last command before it and the first after it, s.
    """

    start: float
    end: float
    command_start: float
    command_end: float


def gaps(time: FloatArray) -> list[tuple[int, float]]:
    """(index of the sample before, median interval in s) of all gaps."""
    steps = np.diff(time)
    usual = _median_interval(steps)
    if len(steps) < 2 or usual <= 0.0:
        return []
    return [(int(at), usual) for at in np.flatnonzero(steps > GAP_INTERVALS * usual)]


def common_gaps(time: FloatArray, command_time: FloatArray) -> list[CommonGap]:
    """Times in which states and commands are missing together, because the recorder lost them.

    A gap in the states alone is not included, because the commands are known. Neither is a gap in
    the commands alone, because the robot kept its last command.

    Args:
        time, command_time: stamps of states and commands, s, not decreasing.
    """
    states, commands = np.unique(time), np.unique(command_time)
    steps, sent = np.diff(states), np.diff(commands)
    usual, usual_sent = _median_interval(steps), _median_interval(sent)
    if min(len(steps), len(sent)) < 3 or min(usual, usual_sent) <= 0.0:
        return []
    near = _TOGETHER * max(usual, usual_sent)
    least = _MISSING_INTERVALS * usual if _is_regular(steps, usual) else GAP_INTERVALS * usual
    least_sent = (
        _MISSING_INTERVALS * usual_sent
        if _is_regular(sent, usual_sent)
        else GAP_INTERVALS * usual_sent
    )
    found = []
    for at in np.flatnonzero(steps > least).tolist():
        first, last = states[at], states[at + 1]
        k = int(np.searchsorted(commands, 0.5 * (first + last), side="right")) - 1
        if not 0 <= k < len(sent) or sent[k] <= least_sent:
            continue
        if steps[at] <= GAP_INTERVALS * usual and sent[k] <= GAP_INTERVALS * usual_sent:
            continue
        if abs(first - commands[k]) <= near and abs(last - commands[k + 1]) <= near:
            sent_last, sent_first = float(commands[k]), float(commands[k + 1])
            found.append(CommonGap(float(first), float(last), sent_last, sent_first))
    return found


def stretches(trial: Trial) -> list[Trial]:
    """Split a trial where states and commands are missing; each part has its own first state.

    The commands in such a gap are unknown, so that the motion after it cannot be predicted from the
    state before it.

    Returns:
        The parts, or the trial itself without such a gap.
    """
    found = [
        gap
        for gap in common_gaps(trial.state_times, trial.command_times)
        if _is_empty(trial.time, gap.start, gap.end)
        and _is_empty(trial.command_time, gap.command_start, gap.command_end)
    ]
    if not found:
        return [trial]
    starts = [-np.inf, *(gap.end for gap in found)]
    ends = [*(gap.start for gap in found), np.inf]
    commands = [-np.inf, *(gap.command_end for gap in found)]
    note = (
        f"cut into {len(found) + 1} parts: states and commands are both missing "
        + _times(found)
        + ", so that the recorder lost them; each part starts from its own first state"
    )
    parts = []
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        until = commands[i + 1] if i + 1 < len(commands) else np.inf
        part = part_of(trial, start, end, commands[i], until, len(starts))
        unseen = [j for j, q in zip(part.joints, part.position[0], strict=True) if np.isnan(q)]
        if unseen or not len(part.command_time):
            lacks = f"position of {unseen[0]}" if unseen else "command"
            note += f"; the part from {part.offset:.4g} s has no {lacks} and is left out"
        else:
            parts.append(replace(part, notes=()))
    return [replace(parts[0], notes=(note, *trial.notes)), *parts[1:]] if parts else [trial]


def _times(found: Sequence[CommonGap]) -> str:
    shown = [f"from {h.start:.4g} to {h.end:.4g} s" for h in found[:3]]
    more = f" and {len(found) - 3} more times" if len(found) > 3 else ""
    return ", ".join(shown) + more


def part_of(
    trial: Trial, start: float, end: float, sent: float, sent_until: float, parts: int
) -> Trial:
    """The trial's states from ``start`` to ``end``, and commands from ``sent`` to ``sent_until``.

    Args:
        start, end: s from its first state.
        sent, sent_until: likewise; a command at ``sent_until`` is left out.
        parts: number of parts into which the recording is split.
    """
    begin = int(np.searchsorted(trial.time, start))
    rows = slice(begin, int(np.searchsorted(trial.time, end, side="right")))
    command_rows = slice(*np.searchsorted(trial.command_time, (sent, sent_until)).tolist())
    first, stop = float(trial.time[rows][0]), float(trial.time[rows][-1])
    position = trial.position[rows]
    if not np.isfinite(position[0]).all():
        position = position.copy()
        position[0] = _first_known(position)
    return replace(
        trial,
        start=trial.start + round(first * 1e9),
        time=trial.time[rows] - first,
        position=position,
        velocity=None if trial.velocity is None else trial.velocity[rows],
        effort=None if trial.effort is None else trial.effort[rows],
        command_time=trial.command_time[command_rows] - first,
        command=trial.command[command_rows],
        own_commands=None if trial.own_commands is None else trial.own_commands[command_rows],
        marks=tuple(
            _shift_mark(mark, first)
            for mark in trial.marks
            if mark.kind != "gap" and mark.start <= stop and (mark.end >= first or not first)
        )
        + tuple(
            _shift_mark(mark, first)
            for mark in trial.marks
            if mark.kind == "gap" and mark.start >= first and mark.end <= stop
        ),
        offset=trial.offset + first,
        parts=parts,
        base=None if trial.base is None else trial.base.shifted(first),
    )


def _first_known(position: FloatArray) -> FloatArray:
    """(j,) first known position of each joint."""
    first = np.argmax(np.isfinite(position), axis=0)
    row: FloatArray = position[first, np.arange(position.shape[1])]
    return row


def _is_empty(time: FloatArray, start: float, end: float) -> bool:
    """Whether there is no message between two stamps."""
    after, before = np.searchsorted(time, start, side="right"), np.searchsorted(time, end)
    return bool(after >= before)


def _shift_mark(mark: Mark, by: float) -> Mark:
    return replace(mark, start=mark.start - by, end=mark.end - by)


def _median_interval(steps: FloatArray) -> float:
    return float(np.median(steps)) if len(steps) else 0.0


def _is_regular(steps: FloatArray, usual: float) -> bool:
    return bool(np.mean(np.abs(steps - usual) <= _EVEN * usual) >= _EVEN_SHARE)
