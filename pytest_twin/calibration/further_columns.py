"""Test whether errors that a calibration does not estimate explain its residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.solve import Fit

FEWEST_DEGREES = 20
"""Residuals beyond all unknowns from which further ones are tested."""
_NEGLIGIBLE = 1e-9
"""Singular values, relative to the largest, of directions that the residuals do not show."""


@dataclass(frozen=True)
class FurtherColumns:
    """Result of freeing further unknowns, to first order.

    Attributes:
        probability: that residuals without these errors show as much (F test).
        removes: share of the squared residuals that they explain.
        step: (count + further,) least-squares step of all unknowns.
        shift: (count,) change of the unknowns of the fit, m and rad.
        covariance: (count, count) of the unknowns of the fit with the further ones free.
    """

    probability: float
    removes: float
    step: FloatArray
    shift: FloatArray
    covariance: FloatArray


def free_columns(
    fit: Fit, slopes: FloatArray, more: FloatArray, residuals: FloatArray
) -> FurtherColumns:
    """Free further unknowns of a fit.

    Args:
        slopes: (m, count) derivatives of inliers and priors by the unknowns, over their noise.
        more: (m, further) derivatives by the further ones.
        residuals: (m,) over their noise; those of outliers are 0.
    """
    free = np.hstack([slopes, more])
    step, rest_step = (least_squares_step(table, residuals) for table in (free, slopes))
    left, rest = (
        float(np.sum((residuals + table @ moved) ** 2))
        for table, moved in ((free, step), (slopes, rest_step))
    )
    degrees, before = _degrees(fit, free), _degrees(fit, slopes)
    probability = 1.0
    if degrees >= FEWEST_DEGREES and before > degrees and left > 0.0:
        ratio = (rest - left) / (before - degrees) / (left / degrees)
        probability = float(stats.f.sf(ratio, before - degrees, degrees))
    count = slopes.shape[1]
    scatter = left / max(degrees, 1)
    return FurtherColumns(
        probability,
        1.0 - left / rest if rest else 0.0,
        step,
        step[:count] - rest_step,
        np.asarray(scatter * np.linalg.pinv(free.T @ free, rcond=_NEGLIGIBLE)[:count, :count]),
    )


def widened(covariance: FloatArray, wider: FloatArray) -> FloatArray:
    """Return a covariance with the correlations of the second and the larger variances of both."""
    larger = np.sqrt(np.maximum(np.diag(wider), np.diag(covariance)) / np.diag(wider))
    return np.asarray(wider * np.outer(larger, larger))


def least_squares_step(slopes: FloatArray, residuals: FloatArray) -> FloatArray:
    """Return the step of the unknowns that makes (m,) residuals smallest."""
    size = _sizes(slopes)
    step: FloatArray = np.linalg.lstsq(slopes / size, -residuals, rcond=_NEGLIGIBLE)[0] / size
    return step


def _degrees(fit: Fit, slopes: FloatArray) -> int:
    """Number of inlier residuals and priors beyond the rank of the derivatives."""
    terms = zip(fit.problem.terms, fit.kept, strict=True)
    outliers = sum(int((~kept).sum()) * len(term.noise) for term, kept in terms)
    return len(slopes) - outliers - int(np.linalg.matrix_rank(slopes / _sizes(slopes)))


def _sizes(slopes: FloatArray) -> FloatArray:
    sizes: FloatArray = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    return sizes
