"""One covariance from several estimates of it, and from intervals that are wider than it says."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray

_NOTHING = 1e-13
"""Share of the largest variance below which a direction has none."""


def upper_covariance(first: FloatArray, second: FloatArray) -> FloatArray:
    """(n, n) covariance that is nowhere narrower than either: no direction has less variance.

    The widest of two intervals is right for each parameter alone. Correlations of one estimate with
    variances of the other would make combinations too certain, which the first determines well and
    the second does not.

    Args:
        first, second: (n, n) symmetric, positive semidefinite.
    """
    scale = np.sqrt(np.maximum(np.diag(first), np.diag(second)))
    scale = np.where(scale > 0.0, scale, 1.0)
    a, b = (one / np.outer(scale, scale) for one in (first, second))
    values, vectors = np.linalg.eigh(a + b)
    used = values > _NOTHING * max(float(values.max(initial=0.0)), 1e-300)
    root = vectors[:, used] * np.sqrt(values[used])
    inverse = vectors[:, used] / np.sqrt(values[used])
    # Of the sum, each direction is a share of the first and the rest of the second.
    share, axes = np.linalg.eigh(inverse.T @ a @ inverse)
    larger = np.maximum(share, 1.0 - share)
    found = root @ axes
    return np.asarray((found * larger) @ found.T * np.outer(scale, scale))


def with_deviations(covariance: FloatArray, deviation: FloatArray) -> FloatArray:
    """(n, n) with these standard deviations: what is added to a variance varies on its own.

    Args:
        covariance: (n, n).
        deviation: (n,) of the intervals; where it is smaller, correlations are kept.
    """
    own = np.sqrt(np.diag(covariance).clip(1e-300))
    shrunk = np.minimum(1.0, deviation / own)
    found: FloatArray = covariance * np.outer(shrunk, shrunk)
    found[np.diag_indices(len(found))] = deviation**2
    return found
