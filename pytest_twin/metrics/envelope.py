"""A predictive envelope against what was measured: coverage, sharpness, probability integral."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import beta

from pytest_twin.arrays import FloatArray

BINS = 10
"""Of a histogram of the probability integral transform."""
_WIDTH_FLOOR = 1e-12


@dataclass(frozen=True)
class Envelope:
    """The central interval of many traces at every sample.

    Attributes:
        lower, middle, upper: (n, j).
    """

    lower: FloatArray
    middle: FloatArray
    upper: FloatArray

    @property
    def half_width(self) -> FloatArray:
        """(n, j)."""
        return np.maximum(0.5 * (self.upper - self.lower), _WIDTH_FLOOR)


def envelope(traces: FloatArray, share: float) -> Envelope:
    """The interval in which a share of further traces is expected at every sample.

    Quantiles at ``p (m + 1)`` of ``m`` sorted values, so that the expected coverage is the share
    and not less (Weibull's plotting position; Hyndman, Fan, The American Statistician 50, 1996).

    Args:
        traces: (m, n, j).
        share: of the interval.
    """
    tails = (0.5 - 0.5 * share, 0.5, 0.5 + 0.5 * share)
    lower, middle, upper = np.quantile(traces, tails, axis=0, method="weibull")
    return Envelope(lower, middle, upper)


def inside(values: FloatArray, found: Envelope) -> FloatArray:
    """(..., n, j) 1 where values lie in the envelope, else 0."""
    return ((values >= found.lower) & (values <= found.upper)).astype(np.float64)


def coverage_interval(share: float, samples: float, level: float = 0.95) -> tuple[float, float]:
    """Interval of a coverage that was found with so many independent samples.

    Clopper and Pearson (Biometrika 26, 1934), with a number of samples that need not be whole.

    Args:
        share: found.
        samples: effective number.
        level: of the interval.
    """
    tail = 0.5 - 0.5 * level
    hits = share * samples
    low = 0.0 if hits <= 0.0 else float(beta.ppf(tail, hits, samples - hits + 1.0))
    missed = samples - hits
    high = 1.0 if missed <= 1e-9 else float(beta.ppf(1.0 - tail, hits + 1.0, missed))
    return low, high


def tightest(values: FloatArray, found: Envelope, share: float) -> FloatArray:
    """(..., j) half width of the narrowest band of constant width about the middle that covers a
    share of the samples.

    Args:
        values: (..., n, j).
        found: its middle counts.
        share: to cover.
    """
    off = np.abs(values - found.middle)
    return np.asarray(np.maximum(np.quantile(off, share, axis=-2, method="higher"), _WIDTH_FLOOR))


def integral_transform(values: FloatArray, traces: FloatArray) -> FloatArray:
    """(n, j) share of the traces below each value; ties count half.

    Args:
        values: (n, j).
        traces: (m, n, j).
    """
    below = (traces < values).sum(axis=0) + 0.5 * (traces == values).sum(axis=0)
    return np.asarray((below + 0.5) / (len(traces) + 1.0))


def histogram(transform: FloatArray) -> FloatArray:
    """(..., j, ``BINS``) shares of (..., n, j) values of the transform; NaN counts nowhere."""
    which = np.clip(np.floor(transform * BINS), 0, BINS - 1)
    counts = np.stack([(which == k).sum(axis=-2) for k in range(BINS)], axis=-1)
    return np.asarray(counts / np.maximum(counts.sum(axis=-1, keepdims=True), 1))


def uneven(shares: FloatArray) -> FloatArray:
    """(...) how far histograms (..., ``BINS``) are from an even one: mean squared relative
    difference.
    """
    return np.asarray(np.mean((shares * BINS - 1.0) ** 2, axis=-1))
