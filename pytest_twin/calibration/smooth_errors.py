"""Errors that change smoothly with the pose, as a random effect of unknown size.

More observations do not average such errors, and the unknowns of a fit take up a part of them. The
residuals show the rest, and so how large the errors may be. Few observations leave room for large
ones, so the covariance is averaged over all sizes, by how likely the residuals make them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from pytest_twin.arrays import FloatArray

_SIZES = np.concatenate([[0.0], np.geomspace(1e-3, 1e2, 100)])
"""Sizes of the random effect that are tried, relative to the size at which it is as large as the
noise in all residuals together."""
_NEGLIGIBLE = 1e-4
"""Weight of a size below which it is left out, and eigenvalues, relative to the largest, that are
zero up to rounding (as the square root of the precision of a number is 1e-8)."""


@dataclass(frozen=True)
class SmoothErrors:
    """Result of adding errors of unknown size to a fit.

    Attributes:
        probability: that residuals without these errors show as much (likelihood ratio test).
        removes: share of the squared residuals that they explain, at their most likely size.
        evidence: logarithm of the residuals' likelihood, averaged over the sizes, relative to none.
        added: (count, count) what they add to the covariance of the unknowns, about the estimate.
        effects: (k,) most likely errors.
    """

    probability: float
    removes: float
    evidence: float
    added: FloatArray
    effects: FloatArray


def smooth_errors(
    slopes: FloatArray, effects: FloatArray, residuals: FloatArray, count: int
) -> SmoothErrors:
    """Estimate the size of errors by restricted likelihood, and what they add to the covariance.

    The size has a flat prior (Gelman: Prior distributions for variance parameters in hierarchical
    models, 2006).

    Args:
        slopes: (m, p) derivatives of residuals and priors by the unknowns, over their noise.
        effects: (m, k) derivatives by the errors, which have equal variances.
        residuals: (m,) over their noise; those of outliers are 0.
        count: number of residuals and priors without outliers.
    """
    scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    basis, singular, _ = np.linalg.svd(slopes / scale, full_matrices=False)
    basis = basis[:, singular > 1e-10 * singular.max()]
    free = count - basis.shape[1]
    rest = residuals - basis @ (basis.T @ residuals)
    # Among the residuals that no unknown explains, the errors are independent along these axes.
    axes, strengths, _ = np.linalg.svd(effects - basis @ (basis.T @ effects), full_matrices=False)
    along = (axes.T @ rest) ** 2
    total = max(float(rest @ rest), 1e-300)
    apart = max(total - float(along.sum()), 1e-9 * total)
    sizes = _SIZES * np.sqrt(free) / max(float(np.linalg.norm(strengths)), 1e-300)
    variances = 1.0 + np.outer(sizes, strengths) ** 2
    squares = apart + (along / variances).sum(axis=1)
    likelihood = -0.5 * (free * np.log(squares) + np.log(variances).sum(axis=1))
    best = int(np.argmax(likelihood))
    weights = np.exp(likelihood - likelihood[best]) * np.gradient(_SIZES)
    evidence = float(np.log(weights.sum() / _SIZES[-1]) + likelihood[best] - likelihood[0])
    weights /= weights.sum()
    table = np.hstack([slopes / scale, effects])
    normal, right = table.T @ table, table.T @ residuals
    unknowns = slopes.shape[1]
    plain, _ = _solved(normal[:unknowns, :unknowns], right[:unknowns])
    added = np.zeros((unknowns, unknowns))
    removes, most_likely = 0.0, np.zeros(effects.shape[1])
    for at in np.flatnonzero((weights > _NEGLIGIBLE) | (np.arange(len(weights)) == best)):
        if sizes[at] == 0.0:
            continue
        with_prior = normal.copy()
        with_prior[unknowns:, unknowns:] += np.eye(effects.shape[1]) / sizes[at] ** 2
        step, covariance = _solved(with_prior, right)
        # The random effect shares the squared residuals with the noise, which is then smaller.
        scatter = squares[at] / total
        shift = step[:unknowns] - plain[:unknowns]
        added += weights[at] * (scatter * covariance[:unknowns, :unknowns] + np.outer(shift, shift))
        if at == best:
            most_likely = -step[unknowns:]
            removes = 1.0 - float(np.sum((residuals - table @ step) ** 2)) / total
    _, without = _solved(normal[:unknowns, :unknowns], right[:unknowns])
    added -= (1.0 - weights[0]) * without
    values, vectors = np.linalg.eigh(added)
    added = (vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(scale, scale)
    ratio = 2.0 * float(likelihood[best] - likelihood[0])
    probability = 0.5 * float(chi2.sf(ratio, 1)) if best else 1.0
    return SmoothErrors(probability, removes, evidence, np.asarray(added), most_likely)


def _solved(normal: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the solution of normal equations and their inverse, without what they do not fix."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-13, hermitian=True)
    inverse = inverse / np.outer(size, size)
    return np.asarray(inverse @ right), np.asarray(inverse)
