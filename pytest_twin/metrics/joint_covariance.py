"""Combine covariance matrices conservatively, and adjust them to given standard deviations."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray

_NO_VARIANCE = 1e-13
"""Fraction of the largest variance below which a direction counts as without variance."""


def upper_covariance(first: FloatArray, second: FloatArray) -> FloatArray:
    """(n, n) covariance with at least the variance of both matrices in every direction.

    Taking the larger variance of each parameter is not sufficient: with the correlations of the
    other matrix, some combinations of parameters would get too small a variance.

    Args:
        first, second: (n, n) symmetric, positive semidefinite.
    """
    scale = np.sqrt(np.maximum(np.diag(first), np.diag(second)))
    scale = np.where(scale > 0.0, scale, 1.0)
    a, b = (one / np.outer(scale, scale) for one in (first, second))
    values, vectors = np.linalg.eigh(a + b)
    used = values > _NO_VARIANCE * max(float(values.max(initial=0.0)), 1e-300)
    root = vectors[:, used] * np.sqrt(values[used])
    inverse = vectors[:, used] / np.sqrt(values[used])
    # In each direction, the variance of the sum consists of a fraction from either matrix.
    share, axes = np.linalg.eigh(inverse.T @ a @ inverse)
    larger = np.maximum(share, 1.0 - share)
    found = root @ axes
    return np.asarray((found * larger) @ found.T * np.outer(scale, scale))


def with_deviations(covariance: FloatArray, deviation: FloatArray) -> FloatArray:
    """(n, n) covariance with given standard deviations.

    Where a deviation is larger than that of the covariance, the added variance is independent.
    Where it is smaller, the correlations are kept.

    Args:
        covariance: (n, n).
        deviation: (n,) standard deviations, in the units of the parameters.
    """
    own = np.sqrt(np.diag(covariance).clip(1e-300))
    shrunk = np.minimum(1.0, deviation / own)
    found: FloatArray = covariance * np.outer(shrunk, shrunk)
    found[np.diag_indices(len(found))] = deviation**2
    return found
