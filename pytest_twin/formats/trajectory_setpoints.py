"""Setpoints of ``JointTrajectory`` messages, as the joint_trajectory_controller plays them.

Between two points a setpoint is linear with positions alone, a cubic with velocities, and a quintic
with accelerations too. Efforts are linear. A first point after time zero is approached from the
setpoint at that time, with its velocity and acceleration. A message replaces what earlier ones
command after its start; joints that it does not name finish their trajectory. A message without
points stops its joints at their setpoint. After its last point a trajectory holds that point.

Source: ``trajectory.cpp`` and ``joint_trajectory_controller.cpp`` of ros2_controllers, with
``allow_trajectory_replacement``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.formats.ros_serialization import QUANTITIES, Floats, Integers
from pytest_twin.formats.trajectory_course import (
    PointState,
    TooManySetpointsError,
    constant,
    course,
    derivative,
    times_inside,
    value_at,
)


@dataclass(frozen=True, slots=True)
class TrajectoryMessage:
    """Points of one message, which begins at ``start``.

    Attributes:
        names: (j,) joints; without names and points, all joints stop.
        start: time at which the trajectory begins, ns.
        after: (n,) time of each point after the start, ns, increasing; n is 0 for a stop.
        values: quantity -> (n, j), NaN in points without it; None if no point has it.
        acceleration: (n, j) rad/s^2 or m/s^2, likewise.
    """

    names: tuple[str, ...]
    start: int
    after: Integers
    values: Mapping[str, Floats | None]
    acceleration: Floats | None = None


@dataclass(frozen=True, slots=True)
class Setpoints:
    """Sampled setpoints; the command between two of them is linear.

    Attributes:
        time: (m,) ns, increasing.
        message: (m,) index of the message that commands each.
        values: quantity -> (m, j), NaN where a joint has no setpoint at that time; None if no
            message contains it.
        from_first_state: number of messages that begin at the position of the first state.
        from_unknown: number of messages that begin at an unknown setpoint, which is taken to be
            their first point.
        overtaken: number of messages that leave out joints which are still moving.
    """

    time: Integers
    message: Integers
    values: Mapping[str, Floats | None]
    from_first_state: int
    from_unknown: int
    overtaken: int


def play(
    messages: Sequence[TrajectoryMessage],
    names: Sequence[str],
    first_position: Mapping[str, float],
    most_values: int,
) -> Setpoints:
    """Return the setpoints that a controller derives from messages.

    Args:
        messages: in the order of their receipt.
        names: (j,) joints of the returned tables.
        first_position: joint -> its position before the first trajectory, rad or m; joints may be
            missing.
        most_values: largest number of sampled values.

    Raises:
        TooManySetpointsError: more values than ``most_values``.
    """
    tracks = [
        _Track(joints, np.array([first_position.get(name, np.nan) for name in joints]))
        for joints in _groups(messages, names)
    ]
    from_first, unknown, overtaken = 0, 0, 0
    for index, message in enumerate(messages):
        stops_all = not message.names
        named = set(message.names)
        ramps = len(message.after) > 0 and message.after[0] > 0
        starts = []
        leaves_moving = False
        for track in tracks:
            if stops_all or named.issuperset(track.joints):
                starts.append(track.take(message, index))
            else:
                leaves_moving |= track.moves_after(message.start)
        overtaken += leaves_moving
        from_first += ramps and any(start == "first state" for start in starts)
        unknown += ramps and any(start == "unknown" for start in starts)
    sampled, left = [], most_values
    for track in tracks:
        rows = track.sample(left)
        left -= sum(block.size for block in rows.values)
        sampled.append((track.joints, rows))
    return _combine(sampled, names, messages, (from_first, unknown, overtaken))


def _groups(messages: Iterable[TrajectoryMessage], names: Sequence[str]) -> list[tuple[str, ...]]:
    """Joints that always come together in one group, else each joint alone."""
    together = {frozenset(message.names) for message in messages if message.names}
    return [tuple(names)] if together <= {frozenset(names)} else [(name,) for name in names]


@dataclass(slots=True)
class _Segment:
    """A polynomial course of the setpoint; the columns are quantities times joints.

    Attributes:
        begin, end: ns.
        coefficients: (6, c) of powers of the time since ``begin``, s.
        first, last: (c,) values at both ends.
        final: position, velocity and acceleration (j,) from ``end`` on, while nothing follows.
    """

    begin: int
    end: int
    coefficients: Floats
    first: Floats
    last: Floats
    final: tuple[Floats, Floats, Floats]
    message: int


@dataclass(slots=True)
class _Rows:
    """Blocks of rows: (n,) times in ns, (n, c) values, (n,) index of the message."""

    times: list[Integers]
    values: list[Floats]
    messages: list[Integers]

    def add(self, times: Integers | int, values: Floats, message: int) -> None:
        """Append a block of one message."""
        if len(values):
            self.times.append(np.atleast_1d(np.array(times, dtype=np.int64)))
            self.values.append(values)
            self.messages.append(np.full(len(values), message, dtype=np.int64))

    def step_to(self, time: int, value: Floats) -> None:
        """End the rows so that the next one, at ``time``, has ``value``.

        The last value holds until then. A first point at time zero is a step, for which the row
        before it is 1 ns earlier.
        """
        if not self.times:
            return
        last, held = int(self.times[-1][-1]), self.values[-1][-1]
        if not np.array_equal(held, value, equal_nan=True):
            before = self._time_before_last()
            if last < time - 1:
                self.add(time - 1, held[None], int(self.messages[-1][-1]))
                return
            if last == time and (before is None or before < time - 1):
                self.times[-1][-1] -= 1
                return
        if last == time:
            self._remove_last()

    def _time_before_last(self) -> int | None:
        if len(self.times[-1]) > 1:
            return int(self.times[-1][-2])
        return int(self.times[-2][-1]) if len(self.times) > 1 else None

    def _remove_last(self) -> None:
        if len(self.times[-1]) == 1:
            self.times.pop(), self.values.pop(), self.messages.pop()
            return
        self.times[-1] = self.times[-1][:-1]
        self.values[-1] = self.values[-1][:-1]
        self.messages[-1] = self.messages[-1][:-1]


class _Track:
    """Setpoint of joints that always come together."""

    def __init__(self, joints: tuple[str, ...], first_position: Floats) -> None:
        self.joints = joints
        self.count = len(joints)
        self.first_position = first_position
        self.segments: list[_Segment] = []

    def moves_after(self, time: int) -> bool:
        """Whether a segment ends later."""
        return bool(self.segments) and self.segments[-1].end > time

    def take(self, message: TrajectoryMessage, index: int) -> str:
        """Replace the course from the message's start; return where it begins."""
        value, (position, velocity, acceleration) = self._state_at(message.start)
        begins = "setpoint" if self.segments else "first state"
        if begins == "first state" and np.isnan(position).any():
            begins = "unknown"
        self._cut(message.start, value)
        if not len(message.after):
            if self.segments:
                value = value.copy()
                moves = slice(self.count, 2 * self.count)
                value[moves] = 0.0 * value[moves]
                still = (value[: self.count], np.zeros(self.count), np.zeros(self.count))
                self._append(message.start, message.start, constant(value), value, still, index)
            return begins
        points = self._points(message)
        times = (message.start + message.after).tolist()
        if message.after[0] > 0:
            # What is not known before the first point has its value.
            unset = np.isnan(value)
            follows = None if unset[: self.count].all() else points[0]
            state = PointState(
                np.where(unset, points[0].value, value),
                None if follows is None or follows.velocity is None else velocity,
                None if follows is None or follows.acceleration is None else acceleration,
            )
            points.insert(0, state)
            times.insert(0, message.start)
        if len(points) == 1:
            at = points[0].value
            self._append(times[0], times[0], constant(at), at, points[0].state(self.count), index)
        for k in range(len(points) - 1):
            begin, end = points[k], points[k + 1]
            coefficients = course(begin, end, (times[k + 1] - times[k]) * 1e-9, self.count)
            final = end.state(self.count)
            self._append(times[k], times[k + 1], coefficients, end.value, final, index)
        return begins

    def _points(self, message: TrajectoryMessage) -> list[PointState]:
        columns = [message.names.index(name) for name in self.joints]
        empty = np.full((len(message.after), self.count), np.nan)
        tables = [
            empty if table is None else table[:, columns]
            for table in (*(message.values[q] for q in QUANTITIES), message.acceleration)
        ]
        values = np.concatenate(tables[:3], axis=1)
        return [
            PointState(
                values[k],
                tables[1][k] if np.isfinite(tables[1][k]).all() else None,
                tables[3][k] if np.isfinite(tables[3][k]).all() else None,
            )
            for k in range(len(values))
        ]

    def _append(
        self,
        begin: int,
        end: int,
        coefficients: Floats,
        last: Floats,
        final: tuple[Floats, Floats, Floats],
        index: int,
    ) -> None:
        self.segments.append(
            _Segment(begin, end, coefficients, coefficients[0], last, final, index)
        )

    def _state_at(self, time: int) -> tuple[Floats, tuple[Floats, Floats, Floats]]:
        """(c,) setpoint, and position, velocity and acceleration (j,) from which a course goes on.

        After the last point the velocity and acceleration are those of that point.
        """
        at = len(self.segments) - 1
        while at >= 0 and self.segments[at].begin > time:
            at -= 1
        if at < 0:
            value = np.full(3 * self.count, np.nan)
            value[: self.count] = self.first_position
            return value, (self.first_position, np.zeros(self.count), np.zeros(self.count))
        segment = self.segments[at]
        if time >= segment.end:
            return segment.last, segment.final
        since = (time - segment.begin) * 1e-9
        coefficients = segment.coefficients[:, : self.count]
        return value_at(segment.coefficients, since), (
            value_at(coefficients, since),
            value_at(derivative(coefficients), since),
            value_at(derivative(derivative(coefficients)), since),
        )

    def _cut(self, time: int, value: Floats) -> None:
        """Remove the course from ``time`` on, where the setpoint is ``value``."""
        while self.segments and self.segments[-1].begin >= time:
            self.segments.pop()
        if self.segments and self.segments[-1].end > time:
            cut = self.segments[-1]
            cut.end, cut.last = time, value
            cut.final = (value[: self.count], np.zeros(self.count), np.zeros(self.count))

    def sample(self, most_values: int) -> _Rows:
        """Return the rows between which the setpoint is linear."""
        rows = _Rows([], [], [])
        size = 0
        for segment in self.segments:
            rows.step_to(segment.begin, segment.first)
            length = segment.end - segment.begin
            since = times_inside(segment.coefficients, length, self.count, most_values - size)
            curve = np.polynomial.polynomial.polyval(since * 1e-9, segment.coefficients).T
            rows.add(segment.begin, segment.first[None], segment.message)
            rows.add(segment.begin + since, curve, segment.message)
            if segment.end > segment.begin:
                rows.add(segment.end, segment.last[None], segment.message)
            size += (len(since) + 3) * 3 * self.count
            if size > most_values:
                raise TooManySetpointsError
        return rows


def _combine(
    sampled: Sequence[tuple[tuple[str, ...], _Rows]],
    names: Sequence[str],
    messages: Sequence[TrajectoryMessage],
    counts: tuple[int, int, int],
) -> Setpoints:
    flat = [
        (joints, np.concatenate(r.times), np.concatenate(r.values), np.concatenate(r.messages))
        for joints, r in sampled
        if r.times
    ]
    times: Integers = np.unique(np.concatenate([time for _, time, _, _ in flat]))
    message: NDArray[np.int64] = np.zeros(len(times), dtype=np.int64)
    tables = {quantity: np.full((len(times), len(names)), np.nan) for quantity in QUANTITIES}
    for joints, time, values, owners in flat:
        at = np.searchsorted(times, time)
        message[at] = owners
        columns = np.array([names.index(joint) for joint in joints])
        parts = np.split(values, len(QUANTITIES), axis=1)
        for quantity, part in zip(QUANTITIES, parts, strict=True):
            tables[quantity][np.ix_(at, columns)] = part
    given = {q: any(m.values[q] is not None for m in messages) for q in QUANTITIES}
    return Setpoints(
        times, message, {q: tables[q] if given[q] else None for q in QUANTITIES}, *counts
    )
