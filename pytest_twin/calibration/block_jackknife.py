"""Covariance of estimates from observations with correlated errors.

Errors of odometry accumulate along the path, so neighbouring poses share nearly all of them. If
they were assumed independent, the intervals would be far too narrow.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.problem import CalibrationProblem

BLOCKS = 8
"""Number of blocks of neighbouring observations. Fewer, longer blocks allow for longer
correlations, but Student's quantile widens the interval: 2.36 with 8 blocks, 2.78 with 5."""


def is_odometry(problem: CalibrationProblem) -> bool:
    """Whether only poses of a camera's own odometry or SLAM were measured."""
    return problem.plan.has_free_scale and len(problem.terms) == 1


def block_jackknife(
    slopes: FloatArray, residuals: FloatArray, prior: FloatArray
) -> tuple[FloatArray, float]:
    """Covariance (p, p), and half width of a 95 % interval in standard deviations.

    Each block of neighbouring observations is left out in turn, to first order (moving blocks;
    Künsch: The jackknife and the bootstrap for general stationary observations, 1989).

    Args:
        slopes: (n, k, p) derivatives of the residuals, in the order of the path.
        residuals: (n, k) residuals; both are divided by the noise.
        prior: (p, p) information matrix of the priors.

    Raises:
        numpy.linalg.LinAlgError: without one of the blocks an unknown is not determined.
    """
    count, _, unknowns = slopes.shape
    length = max(count // BLOCKS, 1)
    scores = np.einsum("nkp,nk->np", slopes, residuals)
    information = np.einsum("nkp,nkq->npq", slopes, slopes)
    whole = information.sum(axis=0) + prior
    covariance = np.zeros((unknowns, unknowns))
    starts = range(count - length + 1)
    for start in starts:
        out = slice(start, start + length)
        moved = np.linalg.solve(whole - information[out].sum(axis=0), scores[out].sum(axis=0))
        covariance += np.outer(moved, moved)
    parts = count / length
    return covariance * (parts - 1.0) / len(starts), float(student.ppf(0.975, parts - 1.0))
