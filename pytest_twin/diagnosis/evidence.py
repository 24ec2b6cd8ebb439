"""How strongly residuals speak for one hypothesis against another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.effects.base import FloatArray


def effective_samples(residual: FloatArray, lengths: Sequence[int]) -> FloatArray:
    """(signals,) how many independent samples correlated residuals are worth.

    n / (1 + 2 sum of autocorrelations up to the first that is not positive) (Geyer, Statistical
    Science 7, 1992), segment by segment.
    """
    total = np.zeros(residual.shape[1])
    at = 0
    for n in lengths:
        part = residual[at : at + n]
        at += n
        centered = np.nan_to_num(part - part.mean(axis=0))
        size = 1 << (2 * n - 1).bit_length()
        spectrum = np.fft.rfft(centered, size, axis=0)
        covariance = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[:n]
        scale = np.maximum(covariance[0], 1e-300)
        rho = covariance / scale
        for s in range(residual.shape[1]):
            ends = np.flatnonzero(rho[:, s] <= 0.0)
            last = int(ends[0]) if ends.size else n
            time = 1.0 + 2.0 * float(rho[1:last, s].sum())
            # A segment is never worth less than one sample, a constant one no more than that.
            total[s] += max(n / time, 1.0)
    return total


def log_likelihood(residual: FloatArray, floor: FloatArray, effective: FloatArray) -> float:
    """Gaussian log-likelihood with each signal's variance profiled out, not below its floor.

    Every signal counts by its ``effective`` samples; what lies under the floor earns nothing.
    """
    mean_square = np.mean(residual**2, axis=0)
    if not np.isfinite(mean_square).all():
        return -np.inf
    return float(-0.5 * np.sum(effective * np.log(np.maximum(mean_square, floor**2))))
