"""``trajectory_msgs/msg/JointTrajectory``: decode setpoints with times relative to the message."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from pytest_twin.formats import limits
from pytest_twin.formats.json_fields import stamp_of, time_of, values_of
from pytest_twin.formats.ros_serialization import (
    QUANTITIES,
    Batch,
    Cursor,
    Decoded,
    Encoding,
    Floats,
    Integers,
    MessageError,
    check_names,
)

POINT_FIELDS = {"position": "positions", "velocity": "velocities", "effort": "effort"}
"""Quantity -> field of a ``trajectory_msgs/msg/JointTrajectoryPoint``."""


def decode_trajectories(
    data: bytes, starts: Integers, sizes: Integers, encoding: Encoding
) -> Iterator[Decoded]:
    """Decode messages one by one; each batch contains the points of one message."""
    for row, (start, size) in enumerate(zip(starts.tolist(), sizes.tolist(), strict=True)):
        try:
            yield _decode(data[start : start + size], row, encoding)
        except MessageError as error:
            yield row, error


def _decode(message: bytes, row: int, encoding: Encoding) -> Batch:
    cursor = Cursor(message, encoding)
    stamp_at = cursor.header()
    names = cursor.names()
    count = cursor.count("points")
    # Bytes of an empty point: four counts and a duration.
    if 24 * count > len(message):
        raise MessageError("ends inside points")
    after: list[int] = []
    points: list[dict[str, Floats | None]] = []
    for _ in range(count):
        position = cursor.doubles("positions")
        velocity = cursor.doubles("velocities")
        cursor.doubles("accelerations")
        effort = cursor.doubles("effort")
        sec, nanosec = cursor.integers("iI", "time_from_start")
        after.append(sec * 1_000_000_000 + nanosec)
        places = {"position": position, "velocity": velocity, "effort": effort}
        points.append(
            {
                quantity: _read(message, at, cursor.order, quantity, len(names))
                for quantity, at in places.items()
            }
        )
    cursor.end()
    sec, nanosec = np.frombuffer(message, cursor.order + "i4", 2, stamp_at).tolist()
    nanosec %= 2**32
    return _batch(row, names, sec * 1_000_000_000 + nanosec, nanosec >= 10**9, after, points)


def _read(
    message: bytes, at: tuple[int, ...], order: str, quantity: str, joints: int
) -> Floats | None:
    if not at:
        return None
    if len(at) != joints:
        raise MessageError(f"{len(at)} values of {quantity} for {joints} joints")
    return np.frombuffer(message, order + "f8", len(at), at[0]).astype(np.float64)[None]


def trajectory_from_json(found: Mapping[str, object], names: list[str], row: int) -> Batch:
    """Decode one JSON message.

    Raises:
        MessageError: the fields are missing or invalid.
    """
    given = found.get("points")
    if not isinstance(given, list) or not all(isinstance(point, dict) for point in given):
        raise MessageError("points is not a list of objects")
    after = [time_of(point.get("time_from_start"), "time_from_start")[0] for point in given]
    points = [
        {q: values_of(point.get(f), f, len(names)) for q, f in POINT_FIELDS.items()}
        for point in given
    ]
    stamp, bad = stamp_of(found.get("header"))
    return _batch(row, names, stamp, bool(bad), after, points)


def _batch(
    row: int,
    names: list[str],
    stamp: int,
    bad_stamp: bool,
    after: list[int],
    points: Sequence[Mapping[str, Floats | None]],
) -> Batch:
    check_names(names)
    if not points:
        # ros2_control interprets a message without points as: stop and hold the current position.
        raise MessageError("no points: this commands a stop, which is not a setpoint")
    if any(later <= sooner for sooner, later in itertools.pairwise(after)):
        raise MessageError("time_from_start does not increase")
    if after[0] < 0:
        raise MessageError("time_from_start is negative")
    if len(points) * len(names) > limits.MCAP.samples_count:
        raise MessageError("too many points")
    count, joints = len(points), len(names)
    values: dict[str, Floats | None] = {}
    for quantity in QUANTITIES:
        rows = [point[quantity] for point in points]
        filled = [np.full((1, joints), np.nan) if one is None else one for one in rows]
        empty = all(one is None for one in rows)
        values[quantity] = None if empty else np.concatenate(filled)
    return Batch(
        rows=np.full(count, row),
        names=tuple(names),
        stamp=np.full(count, stamp),
        bad_stamp=int(bad_stamp),
        values=values,
        after=np.array(after, dtype=np.int64),
    )


def follow_trajectories(
    start: Integers, time: Integers, tables: Mapping[str, Floats | None]
) -> tuple[Integers, Integers, dict[str, Floats | None]]:
    """Return setpoints as a controller follows them: a new trajectory replaces the one before.

    Where a trajectory is replaced, one setpoint is added: its value at that time, by linear
    interpolation between its points, or its last point, which is held.

    Args:
        start: (n,) time at which each setpoint's trajectory begins, not decreasing, ns.
        time: (n,) time of each setpoint, ns.
        tables: quantity -> (n, j) setpoints.

    Returns:
        (m,) index of the setpoint of each row, (m,) time in ns, quantity -> (m, j) values.
    """
    first = np.flatnonzero(np.concatenate([[True], np.diff(start) != 0]))
    last = np.concatenate([first[1:], [len(start)]])
    rows: list[int] = []
    times: list[int] = []
    reached: dict[int, tuple[int, float]] = {}
    for index, (begin, end) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        follows = index + 1 < len(first)
        until = int(start[first[index + 1]]) if follows else np.iinfo(np.int64).max
        kept = begin + int(np.searchsorted(time[begin:end], until))
        rows += range(begin, kept)
        times += time[begin:kept].tolist()
        if not follows or kept == begin:
            continue
        # A trajectory whose first point is at time zero steps to it.
        edge = until - int(time[first[index + 1]] == until)
        before = int(time[kept - 1])
        if before < edge:
            if kept < end:
                share = (edge - before) / (int(time[kept]) - before)
                reached[len(rows)] = (kept, share)
            rows.append(kept - 1)
            times.append(edge)
    taken = np.array(rows, dtype=np.int64)
    found: dict[str, Floats | None] = {}
    for quantity, table in tables.items():
        if table is None:
            found[quantity] = None
            continue
        values = table[taken]
        for row, (following, share) in reached.items():
            values[row] += share * (table[following] - values[row])
        found[quantity] = values
    return taken, np.array(times, dtype=np.int64), found
