"""Likelihoods of residuals, by which hypotheses are compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray

Likelihood = Callable[[FloatArray, FloatArray, FloatArray], float]
"""Log-likelihood of a residual (samples, signals), given noise floor and effective samples, both
(signals,)."""
NOISE_FLOORS = 1.5
"""Residuals up to this number of noise floors count as noise, because the floor is an estimate. A
signal below this level contains no identifiable effect (``VERDICT.identifiable``)."""
_MEAN_ABSOLUTE_DEVIATION = math.sqrt(2.0 / math.pi)
"""Mean absolute deviation of Gaussian noise, in standard deviations."""


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


def tempered_samples(
    effective: FloatArray,
    mean_square: FloatArray,
    floor: FloatArray,
    recordings: int,
    joints: int,
) -> FloatArray:
    """(signals,) effective sample size if a part of the residual is model error.

    Noise averages out within a recording; model error does not. Let a recording have m effective
    samples, and let model error be the share rho of the residual variance. It then counts as
    m / (1 + (m - 1) rho) samples: the design effect of a cluster (Kish, Survey Sampling, 1965).
    Model error is the residual of the best set of effects above ``NOISE_FLOORS`` noise floors. A
    missing force changes position and effort of its joint. The largest share of a joint's signals
    therefore applies to all its signals.

    Args:
        effective: (signals,) effective samples of all recordings, of :func:`effective_samples`.
            Signals are the positions of all joints, then their efforts if these are fitted.
        mean_square: (signals,) mean squared residuals of the best set of effects.
        floor: (signals,) noise floor.
        recordings: number of recordings.
        joints: number of joints.
    """
    share = np.clip(1.0 - (NOISE_FLOORS * floor) ** 2 / np.maximum(mean_square, 1e-300), 0.0, 1.0)
    by_quantity = share.reshape(-1, joints)
    share = np.broadcast_to(by_quantity.max(axis=0), by_quantity.shape).ravel()
    each = np.maximum(effective / max(recordings, 1), 1.0)
    out: FloatArray = effective / (1.0 + (each - 1.0) * share)
    return out


def consistent_evidence_bound(
    one: FloatArray, other: FloatArray, lengths: Sequence[int], floor: FloatArray
) -> float:
    """Upper bound of a log-likelihood ratio that is consistent across segments.

    The gain of ``one`` over ``other`` is computed for each segment. The bound is twice the squared
    ratio of their mean to its standard error (Vuong, Econometrica 57, 1989). If few segments gain
    and the others lose, the bound is low: the gain may be chance.

    Args:
        one, other: (samples, signals) residuals of the two hypotheses.
        lengths: number of samples of each segment.
        floor: (signals,) noise floor; no variance is smaller than its square.

    Returns:
        The bound; infinite if all segments gain the same.
    """
    variance = np.maximum(np.minimum(np.mean(one**2, axis=0), np.mean(other**2, axis=0)), floor**2)
    gained = np.sum((other**2 - one**2) / variance, axis=1)
    each = np.add.reduceat(gained, np.cumsum([0, *lengths[:-1]]))
    spread = float(np.sum((each - each.mean()) ** 2))
    return 2.0 * float(each.sum()) ** 2 / spread if spread > 0.0 else np.inf


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


def laplace_log_likelihood(residual: FloatArray, floor: FloatArray, effective: FloatArray) -> float:
    """Laplace log-likelihood with each signal's mean absolute deviation profiled out.

    It suits stick-slip motion, where one slide of the wrong length dominates a squared error.
    Arguments and result are as in :func:`log_likelihood`.
    """
    mean_deviation = np.mean(np.abs(residual), axis=0)
    if not np.isfinite(mean_deviation).all():
        return -np.inf
    return float(
        -np.sum(effective * np.log(np.maximum(mean_deviation, _MEAN_ABSOLUTE_DEVIATION * floor)))
    )
