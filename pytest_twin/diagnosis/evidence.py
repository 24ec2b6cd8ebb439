"""Evidence of residuals for one hypothesis against another."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray

Likelihood = Callable[[FloatArray, FloatArray, FloatArray], float]
"""Of a residual (samples, signals), its floor and effective samples (signals,)."""
NOISE_FLOORS = 1.5
"""Residuals of up to this many floors are taken for noise alone: the floor is an estimate, and a
signal below this level contains no identifiable effect (``VERDICT.stands_out``)."""
_OF_NOISE = math.sqrt(2.0 / math.pi)
"""Mean absolute deviation of Gaussian noise, in standard deviations."""


def effective_samples(residual: FloatArray, lengths: Sequence[int]) -> FloatArray:
    """(signals,) how many independent samples correlated residuals are worth.

    n / (1 + 2 sum of autocorrelations up to the first that is not positive) (Geyer, Statistical
    Science 7, 1992), segment by segment.
    """
    total = np.zeros(residual.shape[1])
    ends = np.cumsum(lengths)
    by_length: dict[int, list[int]] = {}
    for end, n in zip(ends, lengths, strict=True):
        by_length.setdefault(n, []).append(end - n)
    for n, starts in by_length.items():
        # (segments, samples, signals): those of one length together.
        part = residual[np.array(starts)[:, None] + np.arange(n)]
        centered = np.nan_to_num(part - part.mean(axis=1, keepdims=True))
        size = 1 << (2 * n - 1).bit_length()
        spectrum = np.fft.rfft(centered, size, axis=1)
        covariance = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, :n]
        rho = covariance / np.maximum(covariance[:, :1], 1e-300)
        # Positive up to the first that is not.
        counts = np.logical_and.accumulate(rho[:, 1:] > 0.0, axis=1)
        time = 1.0 + 2.0 * np.sum(rho[:, 1:], axis=1, where=counts)
        # A segment is never worth less than one sample, a constant one no more than that.
        total += np.maximum(n / time, 1.0).sum(axis=0)
    return total


def tempered_samples(
    effective: FloatArray,
    mean_square: FloatArray,
    floor: FloatArray,
    recordings: int,
    joints: int,
) -> FloatArray:
    """(signals,) effective samples where a part of the residual is error of the model.

    Noise averages out within a recording; what the model does wrong does not. A recording of m
    effective samples, of whose variance the share rho is model error, is worth
    m / (1 + (m - 1) rho) of them: the design effect of a cluster (Kish, Survey Sampling, 1965).
    Model error is what the best set of effects leaves above ``NOISE_FLOORS`` floors. A force that
    the model lacks changes position and effort of its joint, so that the larger share of a joint's
    signals applies to all of them.

    Args:
        effective: (signals,) of all recordings, as :func:`effective_samples` has them. The signals
            are the positions of all joints, then their efforts where these are measured.
        mean_square: (signals,) that the best set of effects leaves.
        floor: (signals,) noise floor.
        recordings: how many there are.
        joints: how many there are.
    """
    share = np.clip(1.0 - (NOISE_FLOORS * floor) ** 2 / np.maximum(mean_square, 1e-300), 0.0, 1.0)
    by_quantity = share.reshape(-1, joints)
    share = np.broadcast_to(by_quantity.max(axis=0), by_quantity.shape).ravel()
    each = np.maximum(effective / max(recordings, 1), 1.0)
    out: FloatArray = effective / (1.0 + (each - 1.0) * share)
    return out


def supported_by_windows(
    one: FloatArray, other: FloatArray, lengths: Sequence[int], floor: FloatArray
) -> float:
    """The most evidence that segments bear out, most of them alike, for one residual over another.

    What is gained in each has a mean and a spread between segments; where both are what Gaussian
    noise makes of two laws of which one is right, the evidence is twice the square of the mean in
    its standard errors (Vuong, Econometrica 57, 1989). A few segments that gain all of it, against
    others that lose, have gained it by chance.

    Args:
        one, other: (samples, signals).
        lengths: samples of each segment.
        floor: (signals,) no variance is less.
    """
    variance = np.maximum(np.minimum(np.mean(one**2, axis=0), np.mean(other**2, axis=0)), floor**2)
    gained = np.sum((other**2 - one**2) / variance, axis=1)
    each = np.add.reduceat(gained, np.cumsum([0, *lengths[:-1]]))
    spread = float(np.sum((each - each.mean()) ** 2))
    return 2.0 * float(each.sum()) ** 2 / spread if spread > 0.0 else np.inf


def log_likelihood(residual: FloatArray, floor: FloatArray, effective: FloatArray) -> float:
    """Gaussian log-likelihood with each signal's variance profiled out, not below its floor.

    Every signal counts by its ``effective`` samples; what lies under the floor earns nothing.
    """
    mean_square = np.mean(residual**2, axis=0)
    if not np.isfinite(mean_square).all():
        return -np.inf
    return float(-0.5 * np.sum(effective * np.log(np.maximum(mean_square, floor**2))))


def laplace_log_likelihood(residual: FloatArray, floor: FloatArray, effective: FloatArray) -> float:
    """The same of a Laplace distribution: by mean absolute deviations, not squared ones.

    Where a joint sticks and slips, one slide that ends elsewhere is most of a squared error, and
    says little of what is followed well.
    """
    mean_deviation = np.mean(np.abs(residual), axis=0)
    if not np.isfinite(mean_deviation).all():
        return -np.inf
    return float(-np.sum(effective * np.log(np.maximum(mean_deviation, _OF_NOISE * floor))))
