"""Leave out states in which a reader that lost its bus wrote zeros in place of positions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries, Recording
from pytest_twin.trial.table import stamp_order
from pytest_twin.words import list_names

# A position that steps to zero and back by this many times its largest other step, and by this
# amount (rad or m), is no motion. A fast joint at a low rate makes other large steps too.
_STEPS, _LEAST_STEP = 3.0, 0.02
# Messages of zeros at the begin or the end of a recording, where only one step shows them.
_FEWEST_AT_END = 3
# A joint that is commanded to less than this fraction of the step may be at zero in earnest.
_COMMANDED = 0.5
# Largest fraction of the messages that may be left out.
_MOST = 0.2
# Runs of zeros per message above which they alternate with other positions.
_ALTERNATES = 0.2
# Largest number of times in a note.
_TIMES = 3


def without_dropouts(recording: Recording) -> Recording:
    """Return the recording without positions that are exactly zero between others far from zero.

    A note says which rows these are. A joint whose command is near zero too is not judged.

    Raises:
        RecordingError: many positions of a joint are such zeros.
    """
    states, commands = recording.series.get("state"), recording.series.get("command")
    if states is None or states.position is None or len(states.stamp) < _FEWEST_AT_END:
        return recording
    order = stamp_order(states.stamp)
    stamp = states.stamp[order]
    position = np.asarray(states.position, dtype=np.float64)[order]
    is_lost = np.zeros(position.shape, dtype=bool)
    for column, joint in enumerate(states.names):
        command = _position_commands(commands, joint, stamp)
        is_lost[:, column] = _lost(position[:, column], command)
    # A message of zeros alone is lost as a whole, also for joints that are near zero.
    is_empty = is_lost.any(axis=1) & ((position == 0.0) | np.isnan(position)).all(axis=1)
    is_lost[is_empty] = True
    if not is_lost.any():
        return recording
    seconds = np.asarray((stamp - stamp[0]) * 1e-9, dtype=np.float64)
    _refuse_many(states, is_lost, seconds, recording.path)
    note = _note(states, order, is_lost, seconds)
    lost_in_file = np.empty_like(is_lost)
    lost_in_file[order] = is_lost
    return replace(
        recording,
        series={**recording.series, "state": _with_gaps(states, lost_in_file)},
        notes=(*recording.notes, note),
    )


def _position_commands(
    commands: JointSeries | None, joint: str, stamp: NDArray[np.int64]
) -> FloatArray | None:
    """(n,) last position command of a joint at each stamp; None without such commands."""
    if commands is None or commands.position is None or joint not in commands.names:
        return None
    values = np.asarray(commands.position[:, commands.names.index(joint)], dtype=np.float64)
    seen = np.flatnonzero(np.isfinite(values))
    if not len(seen):
        return None
    seen = seen[stamp_order(commands.stamp[seen])]
    at = np.searchsorted(commands.stamp[seen], stamp, side="right") - 1
    table: FloatArray = values[seen][np.maximum(at, 0)]
    return table


def _lost(position: FloatArray, command: FloatArray | None) -> NDArray[np.bool_]:
    """(n,) which positions of one joint are zeros between others far from zero."""
    is_lost = np.zeros(len(position), dtype=bool)
    rows = np.flatnonzero(np.isfinite(position))
    values = position[rows]
    is_zero = values == 0.0
    edges = np.flatnonzero(np.diff(is_zero.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    if not len(edges) or is_zero.all():
        return is_lost
    both = ~is_zero[1:] & ~is_zero[:-1]
    others = np.abs(np.diff(values))[both]
    least = max(_LEAST_STEP, _STEPS * float(others.max(initial=0.0)))
    if len(edges) > _ALTERNATES * len(values):
        # Two publishers, one of which sends zeros, are reported as such.
        return is_lost
    for first, after in edges.tolist():
        inside = first > 0 and after < len(values)
        if not inside and after - first < _FEWEST_AT_END:
            continue
        before = abs(values[first - 1]) if first else np.inf
        following = abs(values[after]) if after < len(values) else np.inf
        if min(before, following) <= least:
            continue
        step = min(before, following)
        if command is not None:
            commanded = float(np.median(np.abs(command[rows[first:after]])))
            if commanded < _COMMANDED * step:
                continue
        is_lost[rows[first:after]] = True
    return is_lost


def _refuse_many(
    states: JointSeries, is_lost: NDArray[np.bool_], seconds: FloatArray, path: Path
) -> None:
    share = is_lost.mean(axis=0)
    worst = int(np.argmax(share))
    if share[worst] <= _MOST:
        return
    first = int(np.argmax(is_lost[:, worst]))
    raise RecordingError(
        "positions are exactly zero between others far from zero, as if the reader lost its bus",
        path=path,
        where=f"{states.topic} joint '{states.names[worst]}'",
        value=f"{int(is_lost[:, worst].sum())} of {len(is_lost)} messages, first at "
        f"{seconds[first]:.4g} s",
        expected=f"at most {100 * _MOST:.0f} % of them; record again, or remove these rows",
    )


def _note(
    states: JointSeries, order: NDArray[np.int64], is_lost: NDArray[np.bool_], seconds: FloatArray
) -> str:
    rows = np.flatnonzero(is_lost.any(axis=1))
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    times = [
        f"{seconds[run[0]]:.4g} to {seconds[run[-1]]:.4g} s (messages {order[run].min()} to "
        f"{order[run].max()})"
        for run in runs[:_TIMES]
    ]
    more = f" and {len(runs) - _TIMES} more times" if len(runs) > _TIMES else ""
    joints = [name for name, lost in zip(states.names, is_lost.T, strict=True) if lost.any()]
    count = "1 message" if len(rows) == 1 else f"{len(rows)} messages"
    return (
        f"{states.topic}: left out, positions of {list_names(joints)} are exactly zero between "
        f"others far from zero in {count}: from {', '.join(times)}{more}; a reader that loses its "
        "bus writes such zeros"
    )


def _with_gaps(states: JointSeries, is_lost: NDArray[np.bool_]) -> JointSeries:
    """The states without the lost values, and without messages that lost all of them."""
    keep = ~is_lost.all(axis=1)

    def known(table: FloatArray | None) -> FloatArray | None:
        if table is None:
            return None
        values: FloatArray = np.where(is_lost, np.nan, table)[keep]
        return values

    return replace(
        states,
        stamp=states.stamp[keep],
        log_time=states.log_time[keep],
        position=known(states.position),
        velocity=known(states.velocity),
        effort=known(states.effort),
    )
