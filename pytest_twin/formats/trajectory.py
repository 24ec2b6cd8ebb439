"""``trajectory_msgs/msg/JointTrajectory``: decode setpoints with times relative to the message.

The goals of ROS 1's ``FollowJointTrajectory`` action contain one.
"""

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
STOP = "no points: this commands a stop"
_FIELDS = {**POINT_FIELDS, "acceleration": "accelerations"}


def decode_trajectories(
    data: bytes, starts: Integers, sizes: Integers, encoding: Encoding, *, in_goals: bool = False
) -> Iterator[Decoded]:
    """Decode messages one by one; each batch contains the points of one message.

    Args:
        in_goals: whether the messages are ``control_msgs/FollowJointTrajectoryActionGoal``.
    """
    for row, (start, size) in enumerate(zip(starts.tolist(), sizes.tolist(), strict=True)):
        try:
            yield _decode(data[start : start + size], row, encoding, in_goal=in_goals)
        except MessageError as error:
            yield row, error


def _decode(message: bytes, row: int, encoding: Encoding, *, in_goal: bool) -> Batch:
    cursor = Cursor(message, encoding)
    if in_goal:
        cursor.header()
        cursor.skip(8, "goal_id.stamp")
        cursor.text("goal_id.id")
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
        acceleration = cursor.doubles("accelerations")
        effort = cursor.doubles("effort")
        sec, nanosec = cursor.integers("iI", "time_from_start")
        after.append(sec * 1_000_000_000 + nanosec)
        places = {
            "position": position,
            "velocity": velocity,
            "effort": effort,
            "acceleration": acceleration,
        }
        points.append(
            {
                quantity: _read(message, at, cursor.order, quantity, len(names))
                for quantity, at in places.items()
            }
        )
    if in_goal:
        for tolerances in ("path_tolerance", "goal_tolerance"):
            for _ in range(cursor.count(tolerances)):
                cursor.text(f"{tolerances}.name")
                cursor.skip(24, tolerances, 8)
        cursor.skip(8, "goal_time_tolerance")
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
        {q: values_of(point.get(f), f, len(names)) for q, f in _FIELDS.items()} for point in given
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
    if names or points:
        check_names(names)
    if not points:
        # A stop is one row without values.
        points, after = [dict.fromkeys(_FIELDS)], [0]
    else:
        _check_points(points, after, names)
    if len(points) * len(names) > limits.MCAP.samples_count:
        raise MessageError("too many points")
    count, joints = len(points), len(names)
    tables: dict[str, Floats | None] = {}
    for quantity in _FIELDS:
        rows = [point[quantity] for point in points]
        filled = [np.full((1, joints), np.nan) if one is None else one for one in rows]
        empty = all(one is None for one in rows)
        tables[quantity] = None if empty else np.concatenate(filled)
    return Batch(
        rows=np.full(count, row),
        names=tuple(names),
        stamp=np.full(count, stamp),
        bad_stamp=int(bad_stamp),
        values={quantity: tables[quantity] for quantity in QUANTITIES},
        after=np.array(after, dtype=np.int64),
        acceleration=tables["acceleration"],
    )


def is_stop(batch: Batch) -> bool:
    """Whether a message has no points, which stops its joints."""
    return all(table is None for table in batch.values.values())


def _check_points(
    points: Sequence[Mapping[str, Floats | None]], after: Sequence[int], names: Sequence[str]
) -> None:
    """Check what the controller checks before it accepts a trajectory.

    Raises:
        MessageError: the controller would refuse the trajectory, or a value is not finite.
    """
    if any(later <= sooner for sooner, later in itertools.pairwise(after)):
        raise MessageError("time_from_start does not increase")
    if after[0] < 0:
        raise MessageError("time_from_start is negative")
    given = [{q for q, values in point.items() if values is not None} for point in points]
    for number, quantities in enumerate(given):
        if not quantities & set(QUANTITIES):
            raise MessageError(f"point {number} has no positions, velocities or effort")
        if "position" in given[0] and "position" not in quantities:
            raise MessageError(f"point {number} has no positions, the first point has")
        if "position" in quantities and "position" not in given[0]:
            raise MessageError(f"point {number} has positions, the first point has none")
        if "acceleration" in quantities and "velocity" not in quantities:
            raise MessageError(f"point {number} has accelerations without velocities")
        for quantity, values in points[number].items():
            if values is not None and not np.isfinite(values).all():
                joint = names[int(np.flatnonzero(~np.isfinite(values[0]))[0])]
                raise MessageError(f"{quantity} of {joint!r} in point {number} is not finite")
