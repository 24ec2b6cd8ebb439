"""Compute mean commands over simulation steps, for held and interpolated commands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.segment import Segment
from pytest_twin.trial.setpoint import Setpoint


class CommandsOverSteps:
    """Mean commands over steps; means without a delay are cached.

    Args:
        segments: segments with the same joints.
        timestep: usual time step, s; the cache is for this one.
        idle: (segments, joints) command of joints without recorded commands.
        least, greatest: (segments, joints) range of commands that the drives can follow. In a step
            with a change of command, commands are limited to it before the mean is taken.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        timestep: float,
        idle: FloatArray,
        least: FloatArray,
        greatest: FloatArray,
    ) -> None:
        self.segments = segments
        self.timestep = timestep
        self.idle = idle
        self.least, self.greatest = least, greatest
        self._undelayed: dict[int, FloatArray] = {}
        self._cached: dict[int, _SegmentCommands] = {}
        # Segments that differ in their initial state only have the same commands.
        first: dict[tuple[object, ...], int] = {}
        bounds = np.concatenate([idle, least, greatest], axis=1)
        self._alike = np.array([
            first.setdefault(
                (id(s.command_time), id(s.command), s.is_interpolated, s.start, of.tobytes()), i
            )
            for i, (s, of) in enumerate(zip(segments, bounds, strict=True))
        ])  # fmt: skip

    def means(
        self,
        rows: NDArray[np.int64],
        delay: FloatArray,
        steps: int,
        joints: NDArray[np.int64],
        timestep: float,
    ) -> FloatArray:
        """(rows, steps, columns) mean command over each step.

        Args:
            rows: index of the segment of each row.
            delay: (rows, columns) delay of the command, s.
            steps: number of steps.
            joints: (rows, columns) indices of joints.
            timestep: time step, s.
        """
        # Most rows need the same means. Each is computed once, for all joints of a segment with the
        # same delay together.
        alike = np.broadcast_to(self._alike[rows][:, None], joints.shape)
        requested = np.stack([alike, delay, joints], axis=-1)
        distinct, place = np.unique(requested.reshape(-1, 3), axis=0, return_inverse=True)
        means = np.empty((len(distinct), steps))
        firsts = np.flatnonzero(np.append(True, np.any(np.diff(distinct[:, :2], axis=0), axis=1)))
        for first, end in zip(firsts, np.append(firsts[1:], len(distinct)), strict=True):
            which = distinct[first:end, 2].astype(np.int64)
            segment, late = int(distinct[first, 0]), float(distinct[first, 1])
            means[first:end] = self._means(segment, late, steps, timestep)[which]
        return np.swapaxes(means[place.reshape(joints.shape)], 1, 2)

    def commands_before(
        self, rows: NDArray[np.int64], joints: NDArray[np.int64], until: FloatArray
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Iterate over all commands before some times, from the first one.

        Args:
            rows: index of the segment of each row.
            joints: (rows, columns) indices of joints.
            until: (rows, columns) times on the clocks of the trials, s.

        Yields:
            (rows, columns) commands, and the times in s for which they held before ``until``; 0 for
            later commands.
        """
        which, of = np.unique(self._alike[rows], return_inverse=True)
        held = [self._commands_of(int(r)) for r in which]
        latest = [float(until[of == i].max()) for i in range(len(which))]
        counts = [int(np.searchsorted(h.stamps, t)) for h, t in zip(held, latest, strict=True)]
        most = max(1, *counts)
        stamps = np.full((most + 1, len(which)), np.inf)
        commands = np.empty((most, len(which), held[0].command.shape[1]))
        for i, h in enumerate(held):
            n = min(most, len(h.command))
            stamps[: n + 1, i] = h.stamps[: n + 1]
            commands[:n, i], commands[n:, i] = h.interval_mean[:n], h.command[n - 1]
        row = of[:, None]
        for begun, ended, command in zip(stamps[:-1], stamps[1:], commands, strict=True):
            seconds = np.minimum(ended[row], until) - begun[row]
            yield command[row, joints], np.maximum(seconds, 0.0)

    def _means(self, segment: int, delay: float, steps: int, timestep: float) -> FloatArray:
        """(joints, steps) mean commands of a segment with a delay in s."""
        is_undelayed = delay == 0.0 and timestep == self.timestep
        if (
            is_undelayed
            and segment in self._undelayed
            and self._undelayed[segment].shape[1] >= steps
        ):
            return self._undelayed[segment][:, :steps]
        s = self.segments[segment]
        at = np.asarray(s.start - delay + timestep * np.arange(steps + 1), dtype=np.float64)
        commands = self._commands_of(segment)
        mean = np.diff(commands.sent.integral(at), axis=0).T / timestep
        if commands.in_range is not None:
            change = np.diff(commands.latest_stamp(at)) > 0
            in_range = np.diff(commands.in_range.integral(at), axis=0).T / timestep
            mean = np.where(change, in_range, mean)
        if is_undelayed:
            self._undelayed[segment] = mean
        return mean

    def _commands_of(self, segment: int) -> _SegmentCommands:
        """Commands of a segment, computed once."""
        if segment not in self._cached:
            s = self.segments[segment]
            stamps = np.append(s.command_time, s.command_time[-1] + 1e6)
            command = np.where(np.isnan(s.command), self.idle[segment], s.command)
            in_range = None
            # Interpolated commands hardly change within a step, so their mean is limited instead.
            if not s.is_interpolated:
                within = np.clip(command, self.least[segment], self.greatest[segment])
                if not np.array_equal(within, command):
                    in_range = Setpoint(s.command_time, within, is_linear=False)
            sent = Setpoint(s.command_time, command, is_linear=s.is_interpolated)
            self._cached[segment] = _SegmentCommands(stamps, sent, in_range)
        return self._cached[segment]


@dataclass(frozen=True, slots=True)
class _SegmentCommands:
    """Commands of one segment.

    Attributes:
        stamps: (stamps + 1,) stamps and a time far behind the last one, s.
        in_range: commands within the range that drives can follow; None if they all are.
    """

    stamps: FloatArray
    sent: Setpoint
    in_range: Setpoint | None

    @property
    def command(self) -> FloatArray:
        """(stamps, joints) command at each stamp."""
        return self.sent.value

    @property
    def interval_mean(self) -> FloatArray:
        """(stamps, joints) mean command from each stamp to the next."""
        value = self.sent.value
        if not self.sent.is_linear:
            return value
        return value + 0.5 * np.diff(value, axis=0, append=value[-1:])

    def latest_stamp(self, at: FloatArray) -> NDArray[np.int64]:
        """Index of the latest stamp at each time; 0 before the first one."""
        last = np.searchsorted(self.stamps, at, side="right") - 1
        return np.clip(last, 0, len(self.command) - 1)
