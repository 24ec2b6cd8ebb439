"""What was commanded, held from stamp to stamp, as steps of a simulation see it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pytest_twin.effects.base import FloatArray
from pytest_twin.effects.segment import Segment


class HeldCommands:
    """Means of held commands over steps; what was asked for without a delay is kept.

    Args:
        segments: whose commands; all of the same joints.
        timestep: s, of the steps that are asked for most.
    """

    def __init__(self, segments: Sequence[Segment], timestep: float) -> None:
        self.segments = segments
        self.timestep = timestep
        self._prompt: dict[tuple[int, int], FloatArray] = {}
        self._areas: dict[int, tuple[FloatArray, FloatArray]] = {}

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
        count = self.segments[0].command.shape[1]
        # Most rows ask for the same: each is worked out once.
        asked = np.stack([(rows[:, None] * count + joints).ravel(), delay.ravel()])
        unlike, of = np.unique(asked, axis=1, return_inverse=True)
        means = np.empty((unlike.shape[1], steps))
        for i, (which, late) in enumerate(unlike.T):
            segment, joint = divmod(int(which), count)
            means[i] = self._mean(segment, joint, float(late), steps, timestep)
        return np.swapaxes(means[of.reshape(joints.shape)], 1, 2)

    def _mean(
        self, segment: int, joint: int, delay: float, steps: int, timestep: float
    ) -> FloatArray:
        kept = (segment, joint)
        prompt = delay == 0.0 and timestep == self.timestep
        if prompt and len(self._prompt.get(kept, ())) >= steps:
            return self._prompt[kept][:steps]
        s = self.segments[segment]
        at = s.start - delay + timestep * np.arange(steps + 1)
        far, area = self._area(segment)
        # Before the first stamp the first command holds.
        summed = np.interp(at, far, area[joint])
        summed += np.minimum(at - far[0], 0.0) * s.command[0, joint]
        mean: FloatArray = np.diff(summed) / timestep
        if prompt:
            self._prompt[kept] = mean
        return mean

    def _area(self, segment: int) -> tuple[FloatArray, FloatArray]:
        """(stamps + 1,) s and (joints, stamps + 1) integral of the held command up to there."""
        if segment not in self._areas:
            s = self.segments[segment]
            far = np.append(s.command_time, s.command_time[-1] + 1e6)
            area = np.zeros((s.command.shape[1], len(far)))
            np.cumsum((np.diff(far)[:, None] * s.command).T, axis=1, out=area[:, 1:])
            self._areas[segment] = far, area
        return self._areas[segment]
