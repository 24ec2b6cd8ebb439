"""Setpoint as a function of time, also between the stamps of commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.recording_options import CommandBetween


@dataclass(frozen=True)
class Setpoint:
    """Setpoint of joints as a function of time, piecewise constant or linear.

    It is constant before the first and after the last time.

    Attributes:
        time: (k,) s, not decreasing.
        value: (k, j) rad, rad/s or N*m (m, m/s or N).
        is_linear: whether the value is linear between two times, or constant with steps.
    """

    time: FloatArray
    value: FloatArray
    is_linear: bool

    def at(self, time: FloatArray) -> FloatArray:
        """(n, j) setpoint at each time (s)."""
        if not self.is_linear:
            held = np.searchsorted(self.time, time, side="right") - 1
            table: FloatArray = self.value[np.maximum(held, 0)]
            return table
        return np.stack([np.interp(time, self.time, v) for v in self.value.T], axis=1)

    def integral(self, time: FloatArray) -> FloatArray:
        """(n, j) exact integral of the setpoint from ``time[0]`` to each time (s)."""
        index = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 1)
        since = time - self.time[index]
        start = self.value[index]
        if not self.is_linear:
            summed: FloatArray = self._area[index] + since[:, None] * start
            return summed
        outside = (since <= 0.0) | (index == len(self.time) - 1)
        end = np.where(outside[:, None], start, self.at(time))
        summed = self._area[index] + 0.5 * since[:, None] * (start + end)
        return summed

    @cached_property
    def _area(self) -> FloatArray:
        """(k, j) integral up to each of ``time``."""
        steps = np.diff(self.time)[:, None]
        between = 0.5 * (self.value[:-1] + self.value[1:]) if self.is_linear else self.value[:-1]
        return np.concatenate([np.zeros((1, self.value.shape[1])), np.cumsum(steps * between, 0)])


def setpoint(
    time: FloatArray,
    command: FloatArray,
    between: CommandBetween,
    own: NDArray[np.bool_] | None = None,
) -> Setpoint:
    """Build the setpoint from commands.

    Args:
        time: (m,) stamps, s, not decreasing; of commands with the same stamp the last is used.
        command: (m, j) commands; a joint that a message does not contain has its last command.
        between: course of a command between two stamps.
        own: (m, j) which joints each message contains; None for all.
    """
    if between == "held":
        return Setpoint(time, command, is_linear=False)
    last = np.append(np.diff(time) > 0.0, True)
    if own is not None and not own.all():
        # A stamp contains a joint if any message with this stamp does.
        groups = np.cumsum(np.append(0, last[:-1].astype(np.int64)))
        together = np.zeros((int(groups[-1]) + 1, own.shape[1]), dtype=bool)
        np.logical_or.at(together, groups, own)
        own = together
    time, command = time[last], command[last]
    if own is None:
        own = np.ones(command.shape, dtype=bool)
    columns = [
        _corners(time[mine], values[mine], between)
        for values, mine in zip(command.T, own.T, strict=True)
    ]
    return _combine(columns)


def _corners(
    time: FloatArray, command: FloatArray, between: CommandBetween
) -> tuple[FloatArray, FloatArray]:
    """Times (s) and values of the piecewise linear setpoint of one joint."""
    if between == "interpolated" or len(time) < 2:
        return time, command
    period = float(np.median(np.diff(time)))
    corners, values = [float(time[0])], [float(command[0])]
    reached = float(command[0])
    for k in range(1, len(time)):
        begun = float(time[k])
        if begun > corners[-1]:
            corners.append(begun)
            values.append(reached)
        end = begun + period
        target = float(command[k])
        if k + 1 < len(time) and time[k + 1] < end:
            # The next command arrives before the setpoint reaches this one.
            end = float(time[k + 1])
            target = reached + (target - reached) * (end - begun) / period
        corners.append(end)
        values.append(target)
        reached = target
    return np.array(corners), np.array(values)


def _combine(columns: Sequence[tuple[FloatArray, FloatArray]]) -> Setpoint:
    """Combine the setpoints of several joints, at the times of all of them."""
    first = columns[0][0]
    if all(np.array_equal(time, first) for time, _ in columns):
        return Setpoint(first, np.stack([v for _, v in columns], axis=1), is_linear=True)
    time = np.unique(np.concatenate([t for t, _ in columns]))
    value = np.stack([np.interp(time, t, v) for t, v in columns], axis=1)
    return Setpoint(time, value, is_linear=True)
