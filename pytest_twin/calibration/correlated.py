"""Covariance of estimates where errors of neighbouring observations are correlated.

Odometry adds up its errors along the way: neighbouring poses share nearly all of them. An estimate
that takes them as independent is far too sure of itself.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.problem import Problem

BLOCKS = 8
"""Parts of the way, each as long as the errors that are left out together. Fewer parts hold longer
correlations, and the interval grows with Student's quantile: 2.36 with 8, 2.78 with 5."""


def is_odometry(problem: Problem) -> bool:
    """Whether poses of a camera's own odometry or SLAM, and nothing else, were measured."""
    return problem.layout.scale and len(problem.terms) == 1


def block_jackknife(
    slopes: FloatArray, residuals: FloatArray, prior: FloatArray
) -> tuple[FloatArray, float]:
    """Covariance (p, p), and half width of a 95 % interval in standard deviations.

    Each stretch of neighbouring observations is left out in turn, to first order (moving blocks;
    Künsch: The jackknife and the bootstrap for general stationary observations, 1989).

    Args:
        slopes: (n, k, p) derivatives of the residuals, in the order of the way.
        residuals: (n, k), both divided by their noise.
        prior: (p, p) information of the priors.

    Raises:
        numpy.linalg.LinAlgError: without one of the stretches an unknown is not determined.
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
