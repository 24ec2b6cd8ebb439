"""What was commanded at every moment, between the stamps too."""

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
    """Commands as a function of time: steps, or lines between corners. Constant beyond both ends.

    Attributes:
        time: (k,) s, not decreasing.
        value: (k, j).
        linear: whether the value moves in a straight line from one time to the next, or stays until
            it and steps there.
    """

    time: FloatArray
    value: FloatArray
    linear: bool

    def at(self, time: FloatArray) -> FloatArray:
        """(n, j) at each time."""
        if not self.linear:
            held = np.searchsorted(self.time, time, side="right") - 1
            table: FloatArray = self.value[np.maximum(held, 0)]
            return table
        return np.stack([np.interp(time, self.time, v) for v in self.value.T], axis=1)

    def integral(self, time: FloatArray) -> FloatArray:
        """(n, j) integral from the first corner to each time, exact."""
        index = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 1)
        since = time - self.time[index]
        start = self.value[index]
        if not self.linear:
            summed: FloatArray = self._area[index] + since[:, None] * start
            return summed
        outside = (since <= 0.0) | (index == len(self.time) - 1)
        end = np.where(outside[:, None], start, self.at(time))
        summed = self._area[index] + 0.5 * since[:, None] * (start + end)
        return summed

    @cached_property
    def _area(self) -> FloatArray:
        """(k, j) integral up to each corner."""
        steps = np.diff(self.time)[:, None]
        between = 0.5 * (self.value[:-1] + self.value[1:]) if self.linear else self.value[:-1]
        return np.concatenate([np.zeros((1, self.value.shape[1])), np.cumsum(steps * between, 0)])


def setpoint(
    time: FloatArray,
    command: FloatArray,
    between: CommandBetween,
    own: NDArray[np.bool_] | None = None,
) -> Setpoint:
    """What commands ask for at every moment.

    Args:
        time: (m,) s, stamps, not decreasing; of commands with one stamp the last counts.
        command: (m, j) as sent; a joint that a message does not carry has its last command.
        between: what a command does between two stamps.
        own: (m, j) which joints each message carries; None where it is all of them.
    """
    if between == "held":
        return Setpoint(time, command, linear=False)
    last = np.append(np.diff(time) > 0.0, True)
    if own is not None and not own.all():
        # A joint's command in a message counts for the stamp, in whichever of its messages.
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
    return _together(columns)


def _corners(
    time: FloatArray, command: FloatArray, between: CommandBetween
) -> tuple[FloatArray, FloatArray]:
    """Corners of one joint's setpoint."""
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
            # The next command comes before this one is reached.
            end = float(time[k + 1])
            target = reached + (target - reached) * (end - begun) / period
        corners.append(end)
        values.append(target)
        reached = target
    return np.array(corners), np.array(values)


def _together(columns: Sequence[tuple[FloatArray, FloatArray]]) -> Setpoint:
    """One setpoint of several joints, with the corners of all of them."""
    first = columns[0][0]
    if all(np.array_equal(time, first) for time, _ in columns):
        return Setpoint(first, np.stack([v for _, v in columns], axis=1), linear=True)
    time = np.unique(np.concatenate([t for t, _ in columns]))
    value = np.stack([np.interp(time, t, v) for t, v in columns], axis=1)
    return Setpoint(time, value, linear=True)
