"""Lag between two signals on one regular grid, by correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate, correlation_lags

from pytest_twin.arrays import FloatArray

_MIN_OVERLAP = 0.3
"""Smallest overlap as a fraction of the shorter signal. Correlations of shorter overlaps are large
by chance."""


@dataclass(frozen=True)
class Lag:
    """Maximum of the cross-correlation of two signals.

    Attributes:
        steps: shift of the second signal to match the first, in grid steps, interpolated by a
            parabola.
        correlation: correlation at this lag, -1 to 1.
        rival: correlation of the second highest peak, divided by ``correlation``.
    """

    steps: float
    correlation: float
    rival: float


def best_lag(first: FloatArray, second: FloatArray, apart: float) -> Lag:
    """Find the lag with the largest Pearson correlation in the overlap.

    Args:
        first: (n,) signal on a regular grid.
        second: (m,) signal on a grid with the same step.
        apart: smallest distance of another peak, in grid steps.
    """
    best = correlations(first, second)
    lags = correlation_lags(len(first), len(second))
    at = int(np.argmax(best))
    fine = 0.0
    if 0 < at < len(best) - 1:
        left, top, right = best[at - 1 : at + 2]
        bend = left - 2.0 * top + right
        fine = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    peaks = np.flatnonzero((best[1:-1] >= best[:-2]) & (best[1:-1] >= best[2:])) + 1
    others = peaks[np.abs(peaks - at) > apart]
    top = float(best[at])
    rival = float(best[others].max() / top) if len(others) and top > 0.0 else 0.0
    return Lag(float(lags[at] + fine), top, rival)


def correlations(mine: FloatArray, theirs: FloatArray) -> FloatArray:
    """(n + m - 1,) Pearson correlation at each lag in the overlap; -1 where it is too short."""
    one, other = np.ones_like(mine), np.ones_like(theirs)
    count = np.round(correlate(one, other, method="fft"))
    count = np.maximum(count, 1.0)

    def sums(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(correlate(a, b, method="fft"), dtype=np.float64)

    mine, theirs = mine - mine.mean(), theirs - theirs.mean()
    first, second = sums(mine, other) / count, sums(one, theirs) / count
    both = sums(mine, theirs) / count - first * second
    spread = (sums(mine**2, other) / count - first**2) * (sums(one, theirs**2) / count - second**2)
    floor = 1e-6 * mine.var() * theirs.var()
    enough = count > _MIN_OVERLAP * min(len(mine), len(theirs))
    usable = enough & (spread > max(floor, 1e-18))
    return np.where(usable, both / np.sqrt(np.maximum(spread, 1e-30)), -1.0)
