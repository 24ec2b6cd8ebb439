"""A smooth table by penalized least squares, cross-validated over whole recordings.

P-splines of first degree (Eilers, Marx, Statistical Science 11, 1996): many knots, and a penalty on
second differences of their values. All sums are taken once for each recording, so that leaving one
out costs one small solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pytest_twin.arrays import FloatArray

STRENGTHS = tuple(10.0**e for e in np.arange(-3.0, 4.5, 1.0))
"""Penalties that compete, relative to the size of the data."""
# Penalty on the values themselves, relative to that on second differences: knots without data go
# to zero.
_RIDGE = 1e-5


def penalty(knots: int) -> FloatArray:
    """(knots, knots) of squared second differences, and a little of squared values."""
    second = np.diff(np.eye(knots), 2, axis=0)
    matrix: FloatArray = second.T @ second + _RIDGE * np.eye(knots)
    return matrix


@dataclass(frozen=True, slots=True)
class Regression:
    """Sums of a weighted least-squares problem, for each recording.

    Attributes:
        gram: (recordings, p, p) of responses.
        moment: (recordings, p) of responses and residual.
        square: (recordings,) of the residual.
        lower: (p,) least values of the coefficients; -inf without.
        tables: number of tables, p / tables knots each.
    """

    gram: FloatArray
    moment: FloatArray
    square: FloatArray
    lower: FloatArray
    tables: int = 1

    def fitted(self, strength: float, left_out: int | None = None) -> FloatArray:
        """(p,) coefficients, from all recordings but one where ``left_out`` is given."""
        gram, moment = self.gram.sum(axis=0), self.moment.sum(axis=0)
        normal = self.normal(strength)
        if left_out is not None:
            gram, moment = gram - self.gram[left_out], moment - self.moment[left_out]
            normal = normal - self.gram[left_out]
        return _bounded(normal, moment, self.lower)

    def normal(self, strength: float) -> FloatArray:
        """(p, p) matrix of the penalized normal equations of all recordings."""
        gram = self.gram.sum(axis=0)
        knots = len(self.lower) // self.tables
        one = penalty(knots)
        matrix: FloatArray = gram.copy()
        for t in range(self.tables):
            some = slice(t * knots, (t + 1) * knots)
            size = np.trace(gram[some, some]) / np.trace(one)
            matrix[some, some] += (strength + 1e-12) * size * one
        return matrix

    def errors(self, coefficients: FloatArray, recording: int) -> float:
        """Squared error of one recording."""
        c = coefficients
        return float(
            self.square[recording] - 2.0 * c @ self.moment[recording] + c @ self.gram[recording] @ c
        )

    def left_out_errors(self, strength: float) -> FloatArray:
        """(recordings,) squared error of each, predicted from the others."""
        each = range(len(self.square))
        return np.array([self.errors(self.fitted(strength, r), r) for r in each])


def _bounded(normal: FloatArray, moment: FloatArray, lower: FloatArray) -> FloatArray:
    """Solution of normal equations; what falls below its lower bound is held there."""
    found = np.where(np.isfinite(lower), lower, 0.0)
    free = np.ones(len(lower), dtype=bool)
    while free.any():
        rest = moment[free] - normal[np.ix_(free, ~free)] @ found[~free]
        found[free] = cho_solve(cho_factor(normal[np.ix_(free, free)]), rest)
        below = free & (found < lower)
        if not below.any():
            break
        found[below] = lower[below]
        free &= ~below
    return found


def standard_error(differences: FloatArray) -> float:
    """Of the sum of independent differences."""
    n = len(differences)
    return float(np.sqrt(n) * np.std(differences, ddof=1)) if n > 1 else np.inf


def simplest(errors: Sequence[FloatArray]) -> int:
    """The last of models, the most complex first, whose error is within one standard error of the
    least (Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, sec. 7.10).

    Errors are compared by their logarithms, so that no recording counts more than another.
    """
    best = int(np.argmin([e.sum() for e in errors]))
    for k in reversed(range(len(errors))):
        more = log_ratio(errors[k], errors[best])
        if k >= best and more.sum() <= standard_error(more):
            return k
    return best


def log_ratio(errors: FloatArray, others: FloatArray) -> FloatArray:
    """(recordings,) logarithm of how many times as large squared errors are as others."""
    ratio: FloatArray = np.log(np.maximum(errors, 1e-12)) - np.log(np.maximum(others, 1e-12))
    return ratio
