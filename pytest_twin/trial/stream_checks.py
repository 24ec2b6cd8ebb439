"""Compare the positions of a recording with its commands: copies, and different units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries, Recording
from pytest_twin.trial.changed_meaning import meaning_changes
from pytest_twin.trial.dropouts import without_dropouts
from pytest_twin.trial.table import stamp_order
from pytest_twin.trial.trial import Trial
from pytest_twin.trial.unwrap_joints import RecordedMotion
from pytest_twin.words import list_names

# Smallest correlation of positions with commands at which their ratio can be one of units, and the
# largest deviation (of its logarithm) from the ratio of a unit. A loop that lags attenuates.
_FOLLOWS, _UNIT_DEVIATION = 0.9, 0.15
# Smallest ratio of positions to commands, or the reverse, that encoder counts have.
_LEAST_COUNTS = 100.0
# s. Times by which positions may follow their commands late.
_LAGS = (0.0, 0.02, 0.05, 0.1, 0.2)
# Fraction of the steps between stamps above which the clock runs backwards.
_BACKWARD = 0.6
# First states that show the speed at the start, and the longest time that they may take, s.
_FIRST_STATES, _BEGIN = 12, 0.5
# rad/s or m/s. Speed at the start that a replay from rest does not neglect. The states show it if a
# start from rest has this many times the squared error of a start in motion.
_STARTS_MOVING, _WORSE = 0.05, 30.0
# Samples below which no correlation is judged.
_FEWEST_SAMPLES = 10
# A joint within this distance of an end of its range, rad or m, is held by its stop.
_AT_STOP = 0.05
# rad or m. A joint that moves less does not show whether its positions are copies.
_MOVED = 0.02
# rad or m. Positions this near to commands are copies: no drive follows a moving setpoint so well,
# and a number with six digits after the point is rounded by less.
_SAME = 1e-6
# Fraction of the positions that are copies, apart from some at the begin.
_COPIED = 0.99
# Commands by which copies may be late, and one by which their stamps may be early.
_LATE = range(-1, 11)
# Changes that show copies. Fewer do if each is a step that no joint makes in one short interval, s.
_FEWEST_CHANGES, _FEWEST_STEPS, _SHORT = 20, 3, 0.1
# Smallest spread of the changes relative to their median. Encoder counts of a joint that follows
# slowly change by one count, and may equal commanded counts.
_SPREAD = 0.1
_WAY_OUT = (
    "measured positions: encoders, not the setpoints of a controller, of mock hardware or of a "
    "data set whose actions were made from its states"
)


def refuse_backward_stamps(series: JointSeries, path: Path) -> None:
    """Check that stamps do not run backwards from message to message.

    Sorted by such stamps, the motion may be reversed in time. A few messages out of order are not
    meant, nor two publishers whose messages alternate.

    Raises:
        RecordingError: they do.
    """
    steps = np.diff(series.stamp)
    backward = int((steps < 0).sum())
    if len(steps) < _FEWEST_SAMPLES or backward <= _BACKWARD * len(steps):
        return
    raise RecordingError(
        "the times run backwards", path=path, where=series.topic,
        value=f"earlier than the one before in {backward} of {len(steps)} messages",
        expected="times that increase: sort the rows by time if the last is written first, else "
        "repair the clock (--clock log where the recorder's times advance)",
    )  # fmt: skip


def note_on_start_in_motion(trial: Trial) -> list[str]:
    """A note on joints that move at the first state, without a recorded velocity."""
    moving = []
    for column, joint in enumerate(trial.joints):
        if trial.velocity is not None and np.isfinite(trial.velocity[0, column]):
            continue
        rows = np.flatnonzero(np.isfinite(trial.position[:, column]))[:_FIRST_STATES]
        if len(rows) < _FIRST_STATES:
            continue
        since = trial.time[rows] - trial.time[rows[0]]
        if not 0.0 < since[-1] <= _BEGIN or np.diff(since).min() <= 0.0:
            continue
        position, powers = trial.position[rows, column], np.vander(since, 4, increasing=True)
        at_rest, moves = (
            np.linalg.lstsq(powers[:, terms], position, rcond=None)
            for terms in ([0, 2, 3], [0, 1, 2])
        )
        speed = abs(float(moves[0][1]))
        if speed > _STARTS_MOVING and float(at_rest[1].sum()) > _WORSE * float(moves[1].sum()):
            moving.append(f"{joint} at about {speed:.2g} rad/s or m/s")
    if not moving:
        return []
    return [
        f"{trial.name} begins in motion ({list_names(moving)}) and has no velocity: the replay "
        "starts at rest, and its error at the begin is not the model's"
    ]


def refuse_other_scale(
    motion: RecordedMotion, ranges: Mapping[str, tuple[float, float] | None] | None = None
) -> None:
    """Check that positions do not follow their commands in the ratio of two units.

    Args:
        ranges: joint -> range in the model; a joint that its stop holds is not judged.

    Raises:
        RecordingError: they do.
    """
    for column, joint in enumerate(motion.joints):
        at = motion.command_columns.get(joint)
        if at is None:
            continue
        position = motion.position[np.isfinite(motion.position[:, column]), column]
        if _is_at_stop(position, (ranges or {}).get(joint)):
            continue
        correlation, ratio = max(_correlation_and_ratio(motion, column, at, late) for late in _LAGS)
        units = _units(ratio) if correlation >= _FOLLOWS else ""
        if units:
            raise RecordingError(
                f"positions move {ratio:.3g} times as far as their commands: {units}",
                path=motion.path,
                where=f"{motion.topic} joint '{joint}'",
                expected="both in rad (m for a sliding joint); in a CSV file a heading may state "
                f"the unit of one of them, such as '{joint}.command [deg]', else convert it",
            )


def doubts(recording: Recording) -> list[str]:
    """Return what these checks say of a recording whose numbers are to stay as they are."""
    states, commands = recording.series.get("state"), recording.series.get("command")
    if states is None or states.position is None:
        return []
    notes: list[str] = []
    try:
        notes += without_dropouts(recording).notes[len(recording.notes) :]
        if commands is None or commands.position is None:
            notes += meaning_changes(_motion(recording, states, None))
        else:
            motion = _motion(recording, states, commands)
            refuse_other_scale(motion)
            notes += check_copies(motion)[1]
            notes += meaning_changes(motion)
    except RecordingError as error:
        notes.append(f"{error.where}: {error.problem} ({error.value})" if error.value else
                     f"{error.where}: {error.problem}")  # fmt: skip
    return [note.replace("left out, positions", "positions") for note in notes]


def _motion(
    recording: Recording, states: JointSeries, commands: JointSeries | None
) -> RecordedMotion:
    """Positions, with the position commands where there are some."""
    seen = stamp_order(states.stamp)
    start = int(states.stamp[seen[0]])
    motion = RecordedMotion(
        recording.path, states.topic, states.names,
        np.asarray((states.stamp[seen] - start) * 1e-9, dtype=np.float64),
        np.asarray(states.position, dtype=np.float64)[seen],
        np.empty(0), np.empty((0, 0)), {},
    )  # fmt: skip
    if commands is None:
        return motion
    sent = stamp_order(commands.stamp)
    return replace(
        motion,
        command_time=np.asarray((commands.stamp[sent] - start) * 1e-9, dtype=np.float64),
        command=np.asarray(commands.position, dtype=np.float64)[sent],
        command_columns={name: at for at, name in enumerate(commands.names)},
    )


def _units(ratio: float) -> str:
    """What a ratio of positions to commands shows; empty if it shows no other unit."""
    for factor, positions, commands in (
        (np.degrees(1.0), "degrees", "rad"),
        (np.radians(1.0), "rad", "degrees"),
    ):
        if abs(np.log(ratio / factor)) < _UNIT_DEVIATION:
            return (
                f"as if positions were in {positions} and commands in {commands} "
                f"(ratio {factor:.4g})"
            )
    if ratio > _LEAST_COUNTS:
        return "as if positions were in encoder counts"
    return "as if commands were in encoder counts" if ratio < 1.0 / _LEAST_COUNTS else ""


def check_copies(motion: RecordedMotion) -> tuple[frozenset[str], list[str]]:
    """Check that positions are not copies of their commands.

    Returns:
        Joints whose positions are copies, and a note on them.

    Raises:
        RecordingError: the positions of all joints that move are copies.
    """
    copies: dict[str, str] = {}
    measured = []
    for column, joint in enumerate(motion.joints):
        position = motion.position[np.isfinite(motion.position[:, column]), column]
        if len(position) < 2 or float(np.ptp(position)) <= _MOVED:
            continue
        at = motion.command_columns.get(joint)
        late = None if at is None else _copied(motion, column, at)
        if late is None:
            measured.append(joint)
        else:
            copies[joint] = late
    if not copies:
        return frozenset(), []
    what = f"positions of {list_names([*copies])} are copies of their commands"
    when = ", ".join(dict.fromkeys(copies.values()))
    if not measured:
        raise RecordingError(
            f"{what}, so that nothing is measured",
            path=motion.path, where=motion.topic, value=when, expected=_WAY_OUT,
        )  # fmt: skip
    return frozenset(copies), [
        f"{motion.topic}: {what} ({when}): nothing is measured there; expected {_WAY_OUT}"
    ]


def _copied(motion: RecordedMotion, column: int, at: int) -> str | None:
    """How late the positions of a joint are copies of its commands; None if they are measured."""
    rows = np.isfinite(motion.position[:, column])
    sent = np.isfinite(motion.command[:, at])
    time, position = motion.time[rows], motion.position[rows, column]
    command_time, command = motion.command_time[sent], motion.command[sent, at]
    if len(command) < 2:
        return None
    moves = np.flatnonzero(np.abs(np.diff(position)) > _SAME) + 1
    changes = np.abs(position[moves] - position[moves - 1])
    if not _show_copies(changes, time):
        return None
    if _are_same(np.interp(time[moves], command_time, command), position[moves]).mean() > _COPIED:
        return "at the same time"
    index = np.searchsorted(command_time, time[moves], side="right") - 1
    same = {}
    for late in (*_LATE, _LATE.stop):
        earlier = index - late
        known = (earlier >= 0) & (earlier < len(command))
        values = command[np.clip(earlier, 0, len(command) - 1)]
        same[late] = known & _are_same(values, position[moves])
    for late in _LATE:
        # Stamps that scatter put a copy beside the command before or after.
        if (same[late] | same[late + 1]).mean() > _COPIED:
            nearest = late if same[late].mean() >= same[late + 1].mean() else late + 1
            if nearest <= 0:
                return "at the same time"
            return "1 command late" if nearest == 1 else f"{nearest} commands late"
    return None


def _show_copies(changes: FloatArray, time: FloatArray) -> bool:
    if len(changes) >= _FEWEST_CHANGES:
        return float(np.std(changes)) > _SPREAD * float(np.median(changes))
    is_short = len(time) > 1 and float(np.median(np.diff(time))) < _SHORT
    return bool(is_short and len(changes) >= _FEWEST_STEPS and (changes > _MOVED).all())


def _are_same(commands: FloatArray, positions: FloatArray) -> NDArray[np.bool_]:
    same: NDArray[np.bool_] = np.abs(commands - positions) <= _SAME
    return same


def _correlation_and_ratio(
    motion: RecordedMotion, column: int, at: int, late: float
) -> tuple[float, float]:
    """Correlation of a joint's positions with its commands, ``late`` s before, and their ratio."""
    sent = np.isfinite(motion.command[:, at])
    command_time, command = motion.command_time[sent] + late, motion.command[sent, at]
    rows = np.isfinite(motion.position[:, column])
    if len(command):
        rows &= motion.time >= command_time[0]
    if not len(command) or rows.sum() < _FEWEST_SAMPLES:
        return 0.0, 1.0
    last = np.searchsorted(command_time, motion.time[rows], side="right") - 1
    asked, moved = command[last] - command[last].mean(), motion.position[rows, column]
    moved = moved - moved.mean()
    power = float(asked @ asked)
    both = np.sqrt(power * float(moved @ moved))
    if both <= 0.0:
        return 0.0, 1.0
    return float(asked @ moved) / both, float(asked @ moved) / power


def _is_at_stop(position: FloatArray, limits: tuple[float, float] | None) -> bool:
    """Whether a joint is at one end of its range all the time, so that commands hardly move it."""
    if limits is None:
        return False
    return bool((position < limits[0] + _AT_STOP).all() or (position > limits[1] - _AT_STOP).all())
