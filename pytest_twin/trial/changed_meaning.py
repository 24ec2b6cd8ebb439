"""Signs that the meaning of positions or commands changes within a recording.

Two tests find the time. A position that jumps between two neighbouring samples cannot be a motion:
names were exchanged, a sign or unit changed, an encoder slipped. And where a joint follows its
position commands, two straight lines of position over command, before and after a time, fit better
than one: the joint reads another way from there on, or no longer follows. Neither can judge a
joint that does not move, and the second one needs commands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.trial.unwrap_joints import RecordedMotion

_FEWEST = 100
"""Samples below which nothing is judged."""
_JUMP, _LEAST_JUMP = 5.0, 0.02
"""Ratio of a jump to the largest departure from smooth motion around it, and smallest jump, rad or
m: small servos stick and slip by up to 0.011 rad from one sample to the next."""
_NEAR, _BESIDE = 25, 2
"""Samples around a jump that show what is smooth; those next to it contain a part of the jump."""
_LONG_INTERVAL = 2.0
"""Ratio of an interval to the median one above which a joint may have moved unseen."""
_LASTS = 0.6
"""Share of a jump by which position and command must differ afterwards, if the command is known. A
joint that reaches its new setpoint within a sample does not."""
_ANSWER = 1.0
"""s. Time within which a joint answers to a step of its command."""
_SAME = 0.1
"""Largest difference, relative to a jump, of two values that are taken as equal."""
_RATIOS = {
    -1.0: "its sign is reversed",
    math.degrees(1.0): "it is in degrees",
    math.radians(1.0): "it is in rad, before in degrees",
}
"""Position after a jump relative to the one before -> what that shows."""
_SAME_RATIO = 0.02
_MOST_JUMPS = 5
"""Jumps above which a joint always moves so, as with a coarse encoder or at a low rate."""
_MOVED = 0.02
"""Standard deviation, rad or m, above which a joint or command shows what it follows."""
_LAGS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)
"""s. Times by which positions may follow their commands late."""
_FOLLOWS, _AGAINST, _HARDLY = 0.95, -0.8, 0.3
"""Correlation above which a joint follows, below which it runs against, and below the size of which
it does not follow its commands."""
_GAIN = (0.7, 1.4)
"""Factors with which drives follow."""
_ZERO = 0.15
"""rad or m. Twice what gravity and friction leave of the commands of a small arm."""
_STEADY = 0.3
"""Largest spread, relative to its size, of a difference that is another zero."""
_UNIT = (0.2, 2.0)
"""Ratio of factors beyond which the unit is another one: drives and friction leave more."""
_APART = 0.5
"""Error of the other rows' line, relative to the command's standard deviation, of a joint that does
not follow: friction and the load leave less of a large motion."""
_DEFLECTION = 0.05
"""rad or m. More than loads and friction deflect a drive by."""
_FASTER = 2.0
"""Ratio of the commands' frequencies above which a drive may be beyond its bandwidth."""
_ONE_SIDE = 0.98
"""Share of the rows with commands on one side of a joint that something holds; those of a drive
that is off lie on both sides, unless it was switched off at an end of the motion."""
_SHORTEST, _FEWEST_THERE = 0.1, 50
"""Share of the recording and samples that a meaning needs to be judged."""
_MOST_ROWS = 4000
"""Rows that are compared; of longer recordings every k-th."""


@dataclass(frozen=True, slots=True)
class _Line:
    """Position of a joint over its command within some rows: correlation and factor."""

    correlation: float
    factor: float
    moved: bool
    commanded: bool

    @property
    def follows(self) -> bool:
        return self.correlation > _FOLLOWS and _GAIN[0] < self.factor < _GAIN[1]


@dataclass(frozen=True, slots=True)
class _Jump:
    """A jump of a joint's position from one sample to the next.

    Attributes:
        before, after: positions, rad or m.
        start, end: times of both samples, s.
    """

    joint: str
    before: float
    after: float
    start: float
    end: float

    @property
    def size(self) -> float:
        return abs(self.after - self.before)


def meaning_changes(motion: RecordedMotion) -> list[str]:
    """Return a note for each joint whose positions or commands mean something else from a time on.

    Args:
        motion: positions and position commands of a recording, unwrapped.
    """
    notes, named = _notes_on_jumps(motion, _jumps(motion))
    for joint in motion.joints:
        if joint not in named:
            notes += _note_on_commands(motion, joint)
    return [f"{motion.topic}: {note}" for note in notes]


def _jumps(motion: RecordedMotion) -> list[_Jump]:
    """Jumps of all joints, in the order of time."""
    jumps = []
    for column, joint in enumerate(motion.joints):
        seen = np.isfinite(motion.position[:, column])
        time, position = motion.time[seen], motion.position[seen, column]
        if len(time) < _FEWEST or not np.ptp(position):
            continue
        departure = _departures(time, position)
        rows = [
            k
            for k in _abrupt_rows(departure, position)
            if _lasts(motion, joint, time, position, k, departure)
        ]
        if len(rows) <= _MOST_JUMPS:
            jumps += [
                _Jump(joint, *position[k : k + 2].tolist(), *time[k : k + 2].tolist()) for k in rows
            ]
    return sorted(jumps, key=lambda jump: jump.start)


def _departures(time: FloatArray, position: FloatArray) -> FloatArray:
    """(n - 1,) what steps exceed the mean of their neighbours by, rad or m; 0 beside a gap."""
    interval = np.diff(time)
    usual = float(np.median(interval))
    even = (interval <= _LONG_INTERVAL * usual) & (interval * _LONG_INTERVAL >= usual)
    even &= interval > 0.0
    even[1:-1] &= even[:-2] & even[2:]
    speed = np.diff(position) / np.where(even, interval, 1.0)
    departure = np.zeros(len(speed))
    departure[1:-1] = np.abs(speed[1:-1] - 0.5 * (speed[:-2] + speed[2:])) * interval[1:-1]
    return np.where(even, departure, 0.0)


def _abrupt_rows(departure: FloatArray, position: FloatArray) -> list[int]:
    """Rows after which a position changes as no smooth motion does."""
    steps = np.diff(position)
    sizes = np.abs(steps)
    least = max(_LEAST_JUMP, _JUMP * float(sizes[sizes > 0.0].min()))
    usually = float(np.quantile(departure, 0.99))
    rows = []
    for k in np.flatnonzero(departure > max(least, _JUMP * usually)).tolist():
        near = np.arange(max(k - _NEAR, 0), min(k + _NEAR + 1, len(steps)))
        apart = np.abs(near - k)
        around = float(departure[near[apart > _BESIDE]].max(initial=0.0))
        beside = near[(apart > 0) & (apart <= _BESIDE)]
        if departure[k] <= _JUMP * around or sizes[k] < sizes[beside].max(initial=0.0):
            continue
        # One sample off the line is an outlier: its two steps cancel out.
        if np.abs(steps[k] + steps[beside]).min(initial=np.inf) > 0.5 * sizes[k]:
            rows.append(k)
    return rows


def _lasts(
    motion: RecordedMotion,
    joint: str,
    time: FloatArray,
    position: FloatArray,
    k: int,
    departure: FloatArray,
) -> bool:
    """Whether no command explains the jump after row k.

    Without commands of the joint, the rest of its motion has to be far from such jumps.
    """
    jump = float(position[k + 1] - position[k])
    at = motion.command_columns.get(joint)
    if at is None or not np.isfinite(motion.command[:, at]).any():
        beside = slice(max(k - _BESIDE, 0), k + _BESIDE + 1)
        others = np.sort(np.delete(departure, np.arange(len(departure))[beside]))
        return abs(jump) > _JUMP * float(others[-_MOST_JUMPS])
    sent = np.isfinite(motion.command[:, at])
    command_time, command = motion.command_time[sent], motion.command[sent, at]
    recent = (command_time[1:] >= time[k] - _ANSWER) & (command_time[1:] <= time[k + 1])
    if float(np.abs(np.diff(command))[recent].max(initial=0.0)) < (1.0 - _LASTS) * abs(jump):
        return True
    index = np.searchsorted(command_time, time, side="right") - 1
    apart = (position - command[np.maximum(index, 0)]) * np.sign(jump)
    change = np.median(apart[k + 1 : k + 1 + _NEAR]) - np.median(apart[max(k - _NEAR, 0) : k + 1])
    rest = apart[k + 1 :]
    lasts = np.median(rest) - np.median(apart[: k + 1]) > _LASTS * abs(jump)
    # With another sign, unit or joint, the difference varies from there on.
    return bool(change > _LASTS * abs(jump) and (lasts or rest.std() > _LASTS * abs(jump)))


def _notes_on_jumps(motion: RecordedMotion, jumps: list[_Jump]) -> tuple[list[str], set[str]]:
    """Notes on jumps, and the joints that they name."""
    notes = []
    named: set[str] = set()
    for jump in jumps:
        if jump.joint in named:
            continue
        named.add(jump.joint)
        other = _exchanged_with(motion, jump)
        if other is not None:
            named.add(other)
            notes.append(
                f"from {jump.end:.4g} s on the positions of {jump.joint!r} and {other!r} "
                "continue each other: their names or columns are exchanged there; cut the "
                "recording there"
            )
            continue
        meaning = next(
            (
                words
                for ratio, words in _RATIOS.items()
                if abs(jump.after - ratio * jump.before) < _SAME_RATIO * jump.size
            ),
            "another zero (slipped encoder, skipped tooth, homing), unit or joint",
        )
        notes.append(
            f"the position of {jump.joint!r} jumps from {jump.before:.4g} to {jump.after:.4g} "
            f"within {1e3 * (jump.end - jump.start):.3g} ms at {jump.end:.4g} s, as no motion "
            f"does: {meaning} from there on; cut the recording there"
        )
    return notes, named


def _exchanged_with(motion: RecordedMotion, jump: _Jump) -> str | None:
    """The joint that goes on where this one was, and the other way round; None for none."""
    for column, joint in enumerate(motion.joints):
        seen = np.flatnonzero(np.isfinite(motion.position[:, column]))
        before = seen[motion.time[seen] <= jump.start]
        after = seen[motion.time[seen] >= jump.end]
        if joint == jump.joint or not len(before) or not len(after):
            continue
        apart = (
            abs(jump.after - float(motion.position[before[-1], column])),
            abs(jump.before - float(motion.position[after[0], column])),
        )
        if max(apart) < _SAME * jump.size:
            return joint
    return None


def _note_on_commands(motion: RecordedMotion, joint: str) -> list[str]:
    """A note on the joint if another relation to its commands holds from a time on."""
    pair = _position_and_command(motion, joint)
    if pair is None:
        return []
    time, position, commands = pair
    column = motion.joints.index(joint)
    lag, split = _best_split(time, position, commands[:, column])
    commands = _at_lag(time, commands, lag)
    command = commands[:, column]
    rests = len(command) - int(np.argmax(command[::-1] != command[-1]))
    if len(command) - rests > max(_FEWEST_THERE, _SHORTEST * len(command)):
        # A command that never changes again has no line that a split could be found by.
        split = rests
    if split is None:
        return []
    right, wrong = slice(0, split), slice(split, None)
    lines = [_line(position[rows], command[rows]) for rows in (right, wrong)]
    when = f"from {time[split]:.4g} s on"
    if not lines[0].follows:
        right, wrong, lines = wrong, right, lines[::-1]
        when = f"up to {time[split]:.4g} s"
    if not lines[0].follows:
        return []
    residual = position - position[right].mean()
    residual -= lines[0].factor * (command - command[right].mean())
    usual, error = residual[right], residual[wrong]
    rms = float(np.sqrt(np.mean(error**2)))
    if rms < max(_JUMP * float(np.sqrt(np.mean(usual**2))), _DEFLECTION):
        return []
    words = ""
    if lines[1].follows:
        # The same motion about another zero.
        if rms > _ZERO and float(np.std(error)) < _STEADY * rms:
            words = (
                f"is {float(np.mean(error)):.3g} away from where it is otherwise: another zero, or "
                "a load that deflects it"
            )
    elif rms > _APART * float(command[wrong].std()):
        words = _meaning(lines[1], motion, joint, position[wrong], commands[wrong])
        if "does not" in words and not _is_as_slow(time, command, wrong, right):
            return []
    return [f"{when} the position of {joint!r} {words}; cut the recording there"] if words else []


def _meaning(
    line: _Line, motion: RecordedMotion, joint: str, position: FloatArray, commands: FloatArray
) -> str:
    """What a position does that does not follow its command; empty if the rows do not show it."""
    if not line.commanded:
        return "moves although its command rests" if position.std() > _DEFLECTION else ""
    if line.moved and line.correlation < _AGAINST:
        return "runs against its command: the sign of one of them is reversed"
    if line.moved and line.correlation > (_FOLLOWS if line.factor < 1.0 else -_AGAINST):
        if _UNIT[0] < line.factor < _UNIT[1]:
            return ""
        return f"follows {line.factor:.3g} times its command: another unit, or a gear"
    for column, other in enumerate(motion.joints):
        theirs = _line(position, commands[:, column])
        if other != joint and theirs.moved and theirs.commanded and theirs.follows:
            return f"follows the command of {other!r}: names or columns are exchanged"
    if not line.moved or abs(line.correlation) < _HARDLY:
        beyond = commands[:, motion.joints.index(joint)] - position
        if max((beyond > 0.0).mean(), (beyond < 0.0).mean()) > _ONE_SIDE:
            return (
                "rests while its commands are all beyond it on one side: an object or a stop holds "
                "it, as in a closed gripper, or the drive is off"
            )
        return "does not follow its command: the drive is off, or the command is another motion's"
    return ""


def _position_and_command(
    motion: RecordedMotion, joint: str
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """(n,) times and positions of a joint, and (n, joints) commands there, NaN for none."""
    column = motion.joints.index(joint)
    at = motion.command_columns.get(joint)
    if at is None or not len(motion.command_time):
        return None
    rows = np.flatnonzero(
        np.isfinite(motion.position[:, column]) & (motion.time >= motion.command_time[0])
    )
    rows = rows[:: max(1, len(rows) // _MOST_ROWS)]
    if len(rows) < 2 * _FEWEST_THERE:
        return None
    time, position = motion.time[rows], motion.position[rows, column]
    commands = np.full((len(rows), len(motion.joints)), np.nan)
    for k, name in enumerate(motion.joints):
        source = motion.command_columns.get(name)
        if source is None:
            continue
        sent = np.isfinite(motion.command[:, source])
        if sent.any():
            index = np.searchsorted(motion.command_time[sent], time, side="right") - 1
            commands[:, k] = motion.command[sent, source][np.maximum(index, 0)]
    if not np.isfinite(commands[:, column]).all():
        return None
    return time, position, commands


def _at_lag(time: FloatArray, commands: FloatArray, lag: float) -> FloatArray:
    """(n, ...) commands of ``lag`` s before."""
    earlier = np.maximum(np.searchsorted(time, time - lag, side="right") - 1, 0)
    table: FloatArray = commands[earlier]
    return table


def _best_split(
    time: FloatArray, position: FloatArray, command: FloatArray
) -> tuple[float, int | None]:
    """Lag, s, and row at which two lines of position over command fit best; None for no row."""
    best: tuple[float, float, int | None] = (np.inf, 0.0, None)
    for lag in _LAGS:
        cost, row = _cheapest_split(position, _at_lag(time, command, lag))
        if cost < best[0]:
            best = (cost, lag, row)
    return best[1], best[2]


def _cheapest_split(position: FloatArray, command: FloatArray) -> tuple[float, int | None]:
    """Sum of squares that two lines leave at least, and the row between them; None for no row."""
    count = len(position)
    least = max(_FEWEST_THERE, int(_SHORTEST * count))
    x, y = command - command.mean(), position - position.mean()
    sums = np.cumsum(np.column_stack([np.ones(count), x, y, x * x, x * y, y * y]), axis=0)
    rows = np.arange(least, count - least + 1)
    if not len(rows):
        return np.inf, None
    first = sums[rows - 1]
    cost = _left(first) + _left(sums[-1] - first)
    return float(cost.min()), int(rows[np.argmin(cost)])


def _left(sums: FloatArray) -> FloatArray:
    """(k,) sums of squares that a line leaves, of (k, 6) sums of 1, x, y, xx, xy and yy."""
    n, x, y, xx, xy, yy = sums.T
    across = np.maximum(xx - x * x / n, 1e-12)
    left: FloatArray = yy - y * y / n - (xy - x * y / n) ** 2 / across
    return left


def _is_as_slow(time: FloatArray, command: FloatArray, judged: slice, than: slice) -> bool:
    """Whether commands are not so much faster than the others that no drive follows them."""
    frequency = [
        float(np.abs(np.diff(command[rows])).sum() / (command[rows].std() + 1e-12)
              / (time[rows][-1] - time[rows][0] + 1e-12))
        for rows in (judged, than)
    ]  # fmt: skip
    return frequency[0] <= _FASTER * frequency[1]


def _line(position: FloatArray, command: FloatArray) -> _Line:
    travel, spread = float(position.std()), float(command.std())
    if not np.isfinite(spread) or spread <= 0.0 or travel <= 0.0:
        return _Line(0.0, 0.0, travel > _MOVED, bool(spread > _MOVED))
    related = float(np.corrcoef(position, command)[0, 1])
    return _Line(related, related * travel / spread, travel > _MOVED, spread > _MOVED)
