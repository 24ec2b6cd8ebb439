"""What was commanded, held from stamp to stamp, as steps of a simulation see it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.segment import Segment


class HeldCommands:
    """Means of held commands over steps; what was asked for without a delay is kept.

    Args:
        segments: whose commands; all of the same joints.
        timestep: s, of the steps that are asked for most.
        idle: (segments, joints) what holds where a joint is not commanded.
    """

    def __init__(self, segments: Sequence[Segment], timestep: float, idle: FloatArray) -> None:
        self.segments = segments
        self.timestep = timestep
        self.idle = idle
        self._prompt: dict[int, FloatArray] = {}
        self._areas: dict[int, tuple[FloatArray, FloatArray, FloatArray]] = {}

    def means(
        self,
        rows: NDArray[np.int64],
        delay: FloatArray,
        steps: int,
        joints: NDArray[np.int64],
        timestep: float,
    ) -> FloatArray:
        """Mean over each step of the held command, (rows, steps, columns).

        Args:
            rows: segments; joints: (rows, columns) of them.
            delay: (rows, columns) s.
            steps: how many.
            timestep: s.
        """
        # Most rows ask for the same: each is worked out once, and what one segment's joints ask for
        # at the same time, together.
        asked = np.stack([np.broadcast_to(rows[:, None], joints.shape), delay, joints], axis=-1)
        unlike, of = np.unique(asked.reshape(-1, 3), axis=0, return_inverse=True)
        means = np.empty((len(unlike), steps))
        firsts = np.flatnonzero(np.append(True, np.any(np.diff(unlike[:, :2], axis=0), axis=1)))
        for first, end in zip(firsts, np.append(firsts[1:], len(unlike)), strict=True):
            which = unlike[first:end, 2].astype(np.int64)
            segment, late = int(unlike[first, 0]), float(unlike[first, 1])
            means[first:end] = self._means(segment, late, steps, timestep)[which]
        return np.swapaxes(means[of.reshape(joints.shape)], 1, 2)

    def _means(self, segment: int, delay: float, steps: int, timestep: float) -> FloatArray:
        """(joints, steps)."""
        prompt = delay == 0.0 and timestep == self.timestep
        if prompt and segment in self._prompt and self._prompt[segment].shape[1] >= steps:
            return self._prompt[segment][:, :steps]
        s = self.segments[segment]
        at = s.start - delay + timestep * np.arange(steps + 1)
        far, area, command = self._area(segment)
        last = np.clip(np.searchsorted(far, at, side="right") - 1, 0, len(command) - 1)
        # Before the first stamp the first command holds.
        summed = area[:, last] + command[last].T * (at - far[last])
        mean: FloatArray = np.diff(summed, axis=1) / timestep
        if prompt:
            self._prompt[segment] = mean
        return mean

    def _area(self, segment: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(stamps + 1,) s, (joints, stamps + 1) integral of the held command up to there, and
        (stamps, joints) that command.
        """
        if segment not in self._areas:
            s = self.segments[segment]
            far = np.append(s.command_time, s.command_time[-1] + 1e6)
            command = np.where(np.isnan(s.command), self.idle[segment], s.command)
            area = np.zeros((command.shape[1], len(far)))
            np.cumsum((np.diff(far)[:, None] * command).T, axis=1, out=area[:, 1:])
            self._areas[segment] = far, area, command
        return self._areas[segment]
