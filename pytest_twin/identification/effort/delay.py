"""How much later the efforts are stamped than the motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.essential import SIGNIFICANT
from pytest_twin.identification.effort.least_squares import Linear, solve
from pytest_twin.identification.measured import Measured


@dataclass(frozen=True, slots=True)
class Delay:
    """A delay of all efforts.

    Attributes:
        value: s; negative where the motion is stamped later.
        half_width: s, of the 95 % interval.
    """

    value: float
    half_width: float

    @property
    def is_significant(self) -> bool:
        """Whether it differs from zero."""
        return abs(self.value) * Z95 >= SIGNIFICANT * self.half_width


def delay_of(problem: Linear, rate: float) -> Delay:
    """The delay to first order: effort(t) = needed(t - delay) = needed - delay * d(effort)/dt.

    All parameters of the problem are free beside it, so that friction and inertia cannot pass for
    it. The derivative is that of the measured effort.

    Args:
        problem: rows of all recordings at equal intervals.
        rate: of its rows, Hz.
    """
    slope = _slopes(problem, rate)
    columns = np.concatenate([problem.matrix, -slope[..., None]], axis=2)
    dry = np.concatenate([problem.dry, np.zeros((len(problem.dry), 1), dtype=bool)], axis=1)
    found = solve(replace(problem, matrix=columns, dry=dry, instrument=None))
    return Delay(float(found.values[-1]), float(found.half_width[-1]))


def without_delay(recordings: Sequence[Measured], delay: float) -> tuple[Measured, ...]:
    """The recordings with each effort moved to the time at which it acted.

    Args:
        recordings: as they were read.
        delay: s, by which efforts are stamped late.
    """
    return tuple(
        replace(one, effort=np.column_stack([
            np.interp(one.time + delay, one.time, column) if np.isfinite(column).all() else column
            for column in one.effort.T
        ]))
        for one in recordings
    )  # fmt: skip


def _slopes(problem: Linear, rate: float) -> FloatArray:
    ends = np.cumsum(problem.lengths)
    parts = [
        np.gradient(problem.effort[end - n : end], 1.0 / rate, axis=0)
        for end, n in zip(ends, problem.lengths, strict=True)
    ]
    return np.where(problem.known, np.concatenate(parts), 0.0)
