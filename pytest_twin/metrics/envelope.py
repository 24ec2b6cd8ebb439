"""Compare predictive envelopes with measurements: coverage, sharpness, probability integral."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import beta

from pytest_twin.arrays import FloatArray

BINS = 10
"""Number of bins in a histogram of the probability integral transform."""
_WIDTH_FLOOR = 1e-12
"""Smallest half width of an envelope, which prevents division by zero."""


@dataclass(frozen=True)
class Envelope:
    """Central interval of many traces at each sample.

    Attributes:
        lower, middle, upper: (n, j) lower end, median, upper end, in the unit of the traces.
    """

    lower: FloatArray
    middle: FloatArray
    upper: FloatArray

    @property
    def half_width(self) -> FloatArray:
        """(n, j) half the width of the interval, at least 1e-12."""
        return np.maximum(0.5 * (self.upper - self.lower), _WIDTH_FLOOR)


def envelope(traces: FloatArray, share: float) -> Envelope:
    """Interval that is expected to contain a fraction ``share`` of further traces at each sample.

    The quantiles are at ``p (m + 1)`` of ``m`` sorted values, so that the expected coverage equals
    the fraction (Weibull's plotting position; Hyndman, Fan, The American Statistician 50, 1996).

    Args:
        traces: (m, n, j).
        share: expected coverage, 0 to 1.
    """
    tails = (0.5 - 0.5 * share, 0.5, 0.5 + 0.5 * share)
    lower, middle, upper = np.quantile(traces, tails, axis=0, method="weibull")
    return Envelope(lower, middle, upper)


def is_inside(values: FloatArray, found: Envelope) -> FloatArray:
    """(..., n, j) 1.0 where a value is in the envelope, else 0.0."""
    return ((values >= found.lower) & (values <= found.upper)).astype(np.float64)


def coverage_interval(share: float, samples: float, level: float = 0.95) -> tuple[float, float]:
    """Confidence interval of an observed coverage.

    Clopper and Pearson (Biometrika 26, 1934); the number of samples need not be an integer.

    Args:
        share: observed coverage, 0 to 1.
        samples: effective number of independent samples.
        level: confidence level of the interval.
    """
    tail = 0.5 - 0.5 * level
    hits = share * samples
    low = 0.0 if hits <= 0.0 else float(beta.ppf(tail, hits, samples - hits + 1.0))
    missed = samples - hits
    high = 1.0 if missed <= 1e-9 else float(beta.ppf(1.0 - tail, hits + 1.0, missed))
    return low, high


def smallest_half_width(values: FloatArray, found: Envelope, share: float) -> FloatArray:
    """(..., j) smallest constant half width about the median that covers a fraction of the samples.

    Args:
        values: (..., n, j).
        found: envelope; only its median is used.
        share: fraction of the samples to cover.
    """
    off = np.abs(values - found.middle)
    return np.asarray(np.maximum(np.quantile(off, share, axis=-2, method="higher"), _WIDTH_FLOOR))


def integral_transform(values: FloatArray, traces: FloatArray) -> FloatArray:
    """(n, j) probability integral transform: fraction of the traces below each value, ties half.

    Args:
        values: (n, j).
        traces: (m, n, j).
    """
    below = (traces < values).sum(axis=0) + 0.5 * (traces == values).sum(axis=0)
    return np.asarray((below + 0.5) / (len(traces) + 1.0))


def histogram(transform: FloatArray) -> FloatArray:
    """(..., j, ``BINS``) relative frequencies of (..., n, j) values of the transform."""
    which = np.clip(np.floor(transform * BINS), 0, BINS - 1)
    counts = np.stack([(which == k).sum(axis=-2) for k in range(BINS)], axis=-1)
    return np.asarray(counts / np.maximum(counts.sum(axis=-1, keepdims=True), 1))


def deviation_from_uniform(shares: FloatArray) -> FloatArray:
    """(...) mean squared relative deviation of histograms (..., ``BINS``) from a uniform one."""
    return np.asarray(np.mean((shares * BINS - 1.0) ** 2, axis=-1))
