"""Estimate the delay of efforts against the motion: a late stamp, or a low-pass filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.essential_parameters import SIGNIFICANT
from pytest_twin.identification.effort.instruments import solve_instrumental
from pytest_twin.identification.effort.least_squares import LinearProblem, solve
from pytest_twin.identification.measured_recordings import MeasuredRecording

DELAY, LAG = "robot.effort_delay", "robot.effort_lag"
"""Names of delay and time constant among the parameters of a record."""


@dataclass(frozen=True, slots=True)
class Delay:
    """A delay of all efforts.

    Attributes:
        value: delay, s; negative if the motion is stamped later.
        half_width: half width of the 95 % interval, s.
        name: ``DELAY``, or ``LAG`` for the time constant of a first-order low-pass.
    """

    value: float
    half_width: float
    name: str = DELAY

    @property
    def is_significant(self) -> bool:
        """Whether the value differs from zero at the 95 % level."""
        return abs(self.value) * Z95 >= SIGNIFICANT * self.half_width


def delay_of(
    problem: LinearProblem, recorded: FloatArray, rate: float, along: FloatArray | None = None
) -> Delay:
    """Estimate the delay to first order: effort(t) = model(t - delay) = model - delay d(effort)/dt.

    All parameters of the problem are estimated together with the delay, so that friction and
    inertia do not bias it. The derivative is that of the measured effort. In the closed loop of a
    servo, noise of the positions is in both and looks like a delay. Instrumental variables remove
    this bias.

    Args:
        problem: rows of all recordings at equal intervals.
        recorded: (n, joints) efforts including those of known payloads, which have the same delay.
        rate: sampling rate of the rows, Hz.
        along: (b,) parameters of the effort along the commanded motion; None for least squares.
    """
    slope = _slopes(problem, recorded, rate)
    columns = np.concatenate([problem.matrix, -slope[..., None]], axis=2)
    dry = np.concatenate([problem.dry, np.zeros((len(problem.dry), 1), dtype=bool)], axis=1)
    whole = replace(problem, matrix=columns, dry=dry, instrument=None)
    found = solve(whole)
    if along is not None and problem.instrument is not None:
        quiet = -_slopes(problem, problem.instrument @ along, rate)
        instrument = np.concatenate([problem.instrument, quiet[..., None]], axis=2)
        found = solve_instrumental(replace(whole, instrument=instrument), found)
    return Delay(float(found.values[-1]), float(found.half_width[-1]))


def without_delay(
    recordings: Sequence[MeasuredRecording], value: float, name: str = DELAY
) -> tuple[MeasuredRecording, ...]:
    """Return the recordings with the delay or lag of the efforts removed.

    Args:
        recordings: as they were read.
        value: delay or time constant, s.
        name: ``DELAY``: efforts are shifted in time. ``LAG``: effort + value
            d(effort)/dt is the input of the low-pass.
    """

    def acted(time: FloatArray, column: FloatArray) -> FloatArray:
        if not np.isfinite(column).all():
            return column
        if name == LAG:
            return np.asarray(column + value * np.gradient(column, time))
        return np.asarray(np.interp(time + value, time, column))

    return tuple(
        replace(one, effort=np.column_stack([acted(one.time, c) for c in one.effort.T]))
        for one in recordings
    )


def _slopes(problem: LinearProblem, recorded: FloatArray, rate: float) -> FloatArray:
    ends = np.cumsum(problem.lengths)
    parts = [
        np.gradient(recorded[end - n : end], 1.0 / rate, axis=0)
        for end, n in zip(ends, problem.lengths, strict=True)
    ]
    return np.where(problem.known, np.concatenate(parts), 0.0)
