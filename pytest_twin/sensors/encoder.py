"""Quantization of an encoder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray

_FEWEST = 20
"""Smallest number of different readings from which a step is determined."""
_SAME = 0.05
"""Largest deviation of a difference from a whole number of steps, in steps, by rounding in a
log."""


@dataclass(frozen=True)
class Encoder:
    """Encoder with ``reading = step round(position / step)``.

    Attributes:
        step: quantization step, rad or m.
    """

    step: float

    def measured(self, position: FloatArray) -> FloatArray:
        """Readings of positions, rad or m."""
        return np.asarray(self.step * np.round(position / self.step))

    @property
    def deviation(self) -> float:
        """Standard deviation of a reading for a uniform error of one step, rad or m."""
        return self.step / float(np.sqrt(12.0))


def encoder_of(reading: FloatArray) -> Encoder | None:
    """Return the quantization of (n,) readings; None if they show none.

    The step is the smallest difference between two readings; all others must be whole multiples of
    it.
    """
    values = np.unique(reading)
    apart = np.diff(values)
    apart = apart[apart > 1e-9 * max(float(np.ptp(values)), 1e-12)]
    if len(apart) < _FEWEST:
        return None
    least = float(apart.min())
    multiples = apart / least
    step = float(np.sum(apart) / np.sum(np.round(multiples)))
    off = np.abs(apart / step - np.round(apart / step))
    return Encoder(step) if off.max() < _SAME else None
