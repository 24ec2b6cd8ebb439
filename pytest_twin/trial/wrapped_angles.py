"""Unwrap recorded angles of joints that turn further than their recorded values.

Many drivers record an angle modulo one turn, in [-pi, pi) or [0, 2 pi). A joint that passes the
bound then appears to jump by a turn between two samples. Continuity decides how many turns belong
to each sample, as long as the joint cannot turn far between two samples. Where it can, position
commands decide, and where these do not either, the recording is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

TURN = 2.0 * math.pi
"""rad."""
# Wrapped values lie within one turn. Noise and rounding at both bounds exceed it by this fraction.
_WITHIN_TURN = 1.005
# Multiple of the fastest recorded speed that a joint may reach between two samples.
_FASTER = 2.0
# rad/s. A joint without recorded fast motion may still turn this fast between two samples.
_USUAL_SPEED = 15.0
# Fraction of a turn within which positions follow their commands.
_FOLLOWS = 0.25
# Largest fraction of samples that are spikes.
_SPIKES = 0.02
# Ratio of two tracking errors that decides between two readings of the commands.
_CLEARLY = 2.0
# Fraction of a turn by which all values are outside the range before they are another turn.
_OUTSIDE = 0.1
# Fraction of a turn by which values that are inside the range may be outside.
_INSIDE = 0.02


class AmbiguousTurnsError(ValueError):
    """The number of turns between two samples cannot be determined; the text says where."""


@dataclass(frozen=True)
class JointMotion:
    """Recorded positions of one joint and its position commands.

    Attributes:
        time: (n,) stamps of the positions, s, not decreasing.
        position: (n,) finite, rad.
        command_time: (m,) stamps of the commands, s, not decreasing; empty without commands.
        command: (m,) finite, rad.
    """

    time: FloatArray
    position: FloatArray
    command_time: FloatArray
    command: FloatArray

    def commands_at(self, time: FloatArray) -> FloatArray:
        """(n,) command in effect at each time; the first one before it."""
        at = np.searchsorted(self.command_time, time, side="right") - 1
        return self.command[np.maximum(at, 0)]


@dataclass(frozen=True)
class Unwrapped:
    """Positions and commands of one joint with all their turns.

    Attributes:
        position: (n,) rad.
        command: (m,) rad.
        notes: what was changed, without the joint's name.
    """

    position: FloatArray
    command: FloatArray
    notes: tuple[str, ...]


def unwrap(
    motion: JointMotion,
    limits: tuple[float, float] | None,
    turn: float = TURN,
    declared: bool | None = None,
) -> Unwrapped:
    """Return positions and commands of a revolute joint with all their turns.

    Args:
        limits: range of the joint, rad; None if it has none.
        turn: period of the recorded values, rad: a turn of the encoder.
        declared: True if a user declared that the positions are wrapped.

    Raises:
        AmbiguousTurnsError: the positions are wrapped, and the joint could have made another turn
            between two samples.
    """
    recorded = Unwrapped(motion.position, motion.command, ())
    if len(motion.position) < 2:
        return recorded
    if limits is not None and limits[1] - limits[0] <= turn:
        values = np.concatenate([motion.position, motion.command])
        if _is_inside(values, limits, turn):
            return recorded
    position, notes = _positions(motion, limits, turn, declared)
    if not len(motion.command):
        return Unwrapped(position, motion.command, tuple(notes))
    command, command_notes = _commands(motion, position, turn, is_wrapped=bool(notes))
    position, command, shift_notes = _same_turn(motion, position, command, limits, turn)
    return Unwrapped(position, command, (*notes, *command_notes, *shift_notes))


def _positions(
    motion: JointMotion,
    limits: tuple[float, float] | None,
    turn: float,
    declared: bool | None,
) -> tuple[FloatArray, list[str]]:
    """Positions with all their turns, and a note if they were wrapped.

    Raises:
        AmbiguousTurnsError: the joint could have made another turn between two samples.
    """
    position = motion.position
    spikes = _spikes(position, turn)
    rows = np.flatnonzero(~spikes)
    jumps = rows[_jumps(position[rows], turn)]
    reference = float(motion.command[0]) if len(motion.command) else float(position[0])
    is_wrapped = _are_wrapped(motion.time[rows], position[rows], turn)
    if jumps.size and (declared or is_wrapped):
        turns = np.zeros(len(position))
        turns[rows] = _turns_of(position[rows], turn)
        # A spike stays where it was recorded, in the turn of the sample before it.
        before = np.maximum.accumulate(np.where(spikes, 0, np.arange(len(position))))
        unwrapped = position + turn * turns[before]
        doubt = "" if declared else _doubt(motion.time[rows], unwrapped[rows], turn)
        if doubt:
            unwrapped = _by_commands(motion, turn, doubt)
        if limits is not None:
            unwrapped = _into_range(unwrapped, limits, turn, reference)
        if limits is None or _is_inside(unwrapped[rows], limits, turn):
            return unwrapped, [_jumps_note("positions", jumps, motion.time, turn)]
    elif limits is not None and _is_another_turn(position, limits, turn):
        unwrapped = _into_range(position, limits, turn, reference)
        if _is_inside(unwrapped, limits, turn):
            count = round(float(unwrapped[0] - position[0]) / turn)
            note = f"all positions are outside the joint's range: {count:+d} turns added"
            return unwrapped, [note]
    elif not declared and _is_in_window(position[rows], turn):
        doubt = _doubt(motion.time[rows], position[rows], turn)
        if doubt:
            return _without_jumps(motion, turn, doubt)
    return position, []


def _without_jumps(motion: JointMotion, turn: float, doubt: str) -> tuple[FloatArray, list[str]]:
    """Positions within one turn whose turns are in doubt, and a note."""
    try:
        unwrapped = _by_commands(motion, turn, doubt)
    except AmbiguousTurnsError:
        return motion.position, [
            f"{doubt}: taken as recorded; if its positions are recorded within one turn, this is "
            "less than half a turn only by assumption"
        ]
    turns = np.rint((unwrapped - motion.position) / turn)
    if (turns == turns[0]).all():
        return motion.position, []
    return unwrapped, [f"{doubt}: its commands decide, and positions after it are in another turn"]


def _spikes(values: FloatArray, turn: float) -> NDArray[np.bool_]:
    """(n,) single samples that are far from both neighbours, which are near each other."""

    def distance(first: FloatArray, second: FloatArray) -> FloatArray:
        difference = second - first
        distances: FloatArray = np.abs(difference - turn * np.rint(difference / turn))
        return distances

    is_spike = np.zeros(len(values), dtype=bool)
    before, middle, after = values[:-2], values[1:-1], values[2:]
    is_spike[1:-1] = (
        (distance(before, middle) > _FOLLOWS * turn)
        & (distance(middle, after) > _FOLLOWS * turn)
        & (distance(before, after) < 0.5 * _FOLLOWS * turn)
    )
    # A joint that turns fast looks so at every sample.
    return is_spike if is_spike.mean() <= _SPIKES else np.zeros_like(is_spike)


def _jumps(values: FloatArray, turn: float) -> NDArray[np.int64]:
    """Indices of the samples after a step of more than half a turn."""
    return np.flatnonzero(np.abs(np.diff(values)) > 0.5 * turn) + 1


def _within_a_turn(values: FloatArray, turn: float) -> bool:
    return float(np.ptp(values)) <= _WITHIN_TURN * turn


def _turns_of(position: FloatArray, turn: float) -> FloatArray:
    """(n,) whole turns to add to positions so that they do not jump."""
    return np.concatenate([[0.0], -np.cumsum(np.rint(np.diff(position) / turn))])


def _are_wrapped(time: FloatArray, position: FloatArray, turn: float) -> bool:
    """Whether positions with jumps are recorded within one turn.

    They are between -half a turn and half a turn, or between 0 and a turn. With another zero, each
    jump has to be nearly a turn, and from one sample to the next.
    """
    if _is_in_window(position, turn):
        return True
    steps, intervals = np.abs(np.diff(position)), np.diff(time)
    jumps = steps > 0.5 * turn
    sudden = (steps > (1.0 - _FOLLOWS) * turn) & (intervals <= 1.5 * np.median(intervals))
    return _within_a_turn(position, turn) and bool(sudden[jumps].all())


def _doubt(time: FloatArray, position: FloatArray, turn: float) -> str:
    """Where the joint may have made another turn between two samples; empty if nowhere.

    Args:
        time: (n,) s.
        position: (n,) positions without jumps, rad.
        turn: period of the recorded values, rad.
    """
    intervals, steps = np.diff(time), np.abs(np.diff(position))
    usual = max(float(np.median(intervals)), 1e-9)
    near = intervals <= 1.5 * usual
    large = np.flatnonzero((steps > _FOLLOWS * turn) & near)
    speeds = steps[near] / np.maximum(intervals[near], 0.5 * usual)
    speed = max(_FASTER * float(speeds.max(initial=0.0)), _USUAL_SPEED * turn / TURN)
    far = np.flatnonzero(speed * intervals >= 0.5 * turn)
    if not (large.size or far.size):
        return ""
    if large.size:
        at = int(large[0])
        return (
            f"at {time[at + 1]:.4g} s it turns by {steps[at]:.3g} or {turn - steps[at]:.3g} rad "
            "from one sample to the next"
        )
    at = int(far[0])
    return (
        f"in the {intervals[at]:.4g} s without a sample after {time[at]:.4g} s it may turn by "
        f"{speed * intervals[at]:.3g} rad"
    )


def _by_commands(motion: JointMotion, turn: float, doubt: str) -> FloatArray:
    """(n,) positions in the turns of the commands.

    Raises:
        AmbiguousTurnsError: the positions do not stay near the commands, or their turns are in
            doubt too.
    """
    if len(motion.command) < 2:
        raise AmbiguousTurnsError(doubt)
    command = motion.command + turn * _turns_of(motion.command, turn)
    tracking_error = motion.position - replace(motion, command=command).commands_at(motion.time)
    turns = np.rint(tracking_error / turn)
    if np.abs(tracking_error - turn * turns).max() > _FOLLOWS * turn:
        raise AmbiguousTurnsError(doubt)
    if _doubt(motion.command_time, command, turn):
        raise AmbiguousTurnsError(doubt)
    return motion.position - turn * turns


def _commands(
    motion: JointMotion, position: FloatArray, turn: float, *, is_wrapped: bool
) -> tuple[FloatArray, list[str]]:
    """Commands with all their turns, if they are wrapped.

    A command may jump by more than half a turn in earnest. The positions show which reading is
    right: they follow it.

    Raises:
        AmbiguousTurnsError: the positions are wrapped and follow neither reading clearly.
    """
    command = motion.command
    near = np.interp(motion.command_time, motion.time, position) - command
    turns = np.rint(near / turn)
    if np.abs(near - turn * turns).max() < _FOLLOWS * turn:
        changes = np.flatnonzero(np.diff(turns)) + 1
        if not changes.size:
            return command, []
        return command + turn * turns, [_jumps_note("commands", changes, motion.command_time, turn)]
    jumps = _jumps(command, turn)
    if not jumps.size or not _within_a_turn(command, turn):
        return command, []
    unwrapped = command + turn * _turns_of(command, turn)
    raw_error, unwrapped_error = (
        _tracking_error(replace(motion, position=position, command=reading), turn)
        for reading in (command, unwrapped)
    )
    if unwrapped_error * _CLEARLY < raw_error:
        return unwrapped, [_jumps_note("commands", jumps, motion.command_time, turn)]
    if is_wrapped and raw_error * _CLEARLY >= unwrapped_error:
        raise AmbiguousTurnsError(
            f"its positions follow neither its commands as recorded (RMS {raw_error:.3g} rad) nor "
            f"the unwrapped ones ({unwrapped_error:.3g} rad)"
        )
    return command, []


def _tracking_error(motion: JointMotion, turn: float) -> float:
    """RMS difference of positions and commands, rad, apart from the turn in which they begin."""
    tracking_error = motion.position - motion.commands_at(motion.time)
    begin = tracking_error[: max(1, len(tracking_error) // 20)]
    return float(np.sqrt(np.mean((tracking_error - turn * np.rint(begin.mean() / turn)) ** 2)))


def _same_turn(
    motion: JointMotion,
    position: FloatArray,
    command: FloatArray,
    limits: tuple[float, float] | None,
    turn: float,
) -> tuple[FloatArray, FloatArray, list[str]]:
    """Positions and commands in the same turn, and a note if one was shifted."""
    tracking_error = position - replace(motion, command=command).commands_at(motion.time)
    turns = float(np.rint(np.median(tracking_error) / turn))
    if not turns or np.abs(tracking_error - turn * turns).max() > _FOLLOWS * turn:
        return position, command, []
    if limits is None:
        note = f"positions differ from their commands by whole turns: {-turns:+.0f} added"
        return position - turn * turns, command, [note]
    note = f"commands differ from their positions by whole turns: {turns:+.0f} added"
    return position, command + turn * turns, [note]


def _into_range(
    values: FloatArray, limits: tuple[float, float], turn: float, reference: float
) -> FloatArray:
    """Values shifted by whole turns into the range, the first one near a reference."""
    lowest = math.ceil((limits[0] - _INSIDE * turn - float(values.min())) / turn)
    highest = math.floor((limits[1] + _INSIDE * turn - float(values.max())) / turn)
    wanted = round((reference - float(values[0])) / turn)
    return values + turn * min(max(wanted, lowest), max(lowest, highest))


def _is_inside(values: FloatArray, limits: tuple[float, float], turn: float) -> bool:
    lower, upper = limits[0] - _INSIDE * turn, limits[1] + _INSIDE * turn
    return bool(values.min() >= lower and values.max() <= upper)


def _is_in_window(values: FloatArray, turn: float) -> bool:
    """Whether values lie in -half a turn to half a turn, or in 0 to one turn."""
    beyond = (_WITHIN_TURN - 1.0) * turn
    return any(
        values.min() >= start - beyond and values.max() <= start + turn + beyond
        for start in (-0.5 * turn, 0.0)
    )


def _is_another_turn(values: FloatArray, limits: tuple[float, float], turn: float) -> bool:
    """Whether all values are outside the range, but within -half a turn to one turn."""
    if values.min() < -0.5 * _WITHIN_TURN * turn or values.max() > _WITHIN_TURN * turn:
        return False
    lower, upper = limits[0] - _OUTSIDE * turn, limits[1] + _OUTSIDE * turn
    return bool(values.min() > upper or values.max() < lower)


def _jumps_note(what: str, jumps: NDArray[np.int64], time: FloatArray, turn: float) -> str:
    count = "once" if len(jumps) == 1 else f"{len(jumps)} times"
    return (
        f"{what} step by {turn:.4g} rad {count} (first at {time[int(jumps[0])]:.4g} s), because "
        "they are recorded within one turn: unwrapped"
    )
