"""Likelihoods of residuals, by which hypotheses are compared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray

NOISE_FLOORS = 1.5
"""Residuals up to this number of noise floors count as noise, because the floor is an estimate. A
signal below this level contains no identifiable effect (``VERDICT.identifiable``)."""


def effective_samples(residual: FloatArray, lengths: Sequence[int]) -> FloatArray:
    """(signals,) effective sample size of correlated residuals.

    For each segment it is n / (1 + 2 sum of autocorrelations). The sum ends before the first
    autocorrelation that is not positive (Geyer, Statistical Science 7, 1992).

    Args:
        residual: (samples, signals), segments stacked.
        lengths: number of samples of each segment.
    """
    total = np.zeros(residual.shape[1])
    ends = np.cumsum(lengths)
    by_length: dict[int, list[int]] = {}
    for end, n in zip(ends, lengths, strict=True):
        by_length.setdefault(n, []).append(end - n)
    for n, starts in by_length.items():
        # (segments, samples, signals) of all segments with this length.
        part = residual[np.array(starts)[:, None] + np.arange(n)]
        centered = np.nan_to_num(part - part.mean(axis=1, keepdims=True))
        size = 1 << (2 * n - 1).bit_length()
        spectrum = np.fft.rfft(centered, size, axis=1)
        covariance = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, :n]
        rho = covariance / np.maximum(covariance[:, :1], 1e-300)
        # Autocorrelations before the first that is not positive.
        counts = np.logical_and.accumulate(rho[:, 1:] > 0.0, axis=1)
        time = 1.0 + 2.0 * np.sum(rho[:, 1:], axis=1, where=counts)
        # A segment counts as at least one sample; a constant residual as exactly one.
        total += np.maximum(n / time, 1.0).sum(axis=0)
    return total


def log_likelihood(residual: FloatArray, floor: FloatArray, effective: FloatArray) -> float:
    """Gaussian log-likelihood with each signal's variance profiled out, not below its floor.

    A reduction of the residual below the floor does not increase the likelihood.

    Args:
        residual: (samples, signals).
        floor: (signals,) noise floor, in the units of the residual.
        effective: (signals,) effective samples.

    Returns:
        The log-likelihood up to a constant; minus infinity if the residual is not finite.
    """
    mean_square = np.mean(residual**2, axis=0)
    if not np.isfinite(mean_square).all():
        return -np.inf
    return float(-0.5 * np.sum(effective * np.log(np.maximum(mean_square, floor**2))))
