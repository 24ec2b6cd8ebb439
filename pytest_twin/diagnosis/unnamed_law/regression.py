"""A smooth table by penalized least squares, cross-validated over whole recordings.

The tables are P-splines of first degree (Eilers, Marx, Statistical Science 11, 1996): many knots,
and a penalty on the second differences of their values. The sums are computed once for each
recording, so that leaving one out only takes the solution of a small system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pytest_twin.arrays import FloatArray

STRENGTHS = tuple(10.0**e for e in np.arange(-3.0, 4.5, 1.0))
"""Penalties that cross-validation chooses from, relative to the diagonal of the normal matrix."""
# Penalty on the values, relative to that on second differences. It sets knots without data to 0.
_RIDGE = 1e-5


def penalty(knots: int) -> FloatArray:
    """(knots, knots) matrix of squared second differences, plus a small multiple of the unit."""
    second = np.diff(np.eye(knots), 2, axis=0)
    matrix: FloatArray = second.T @ second + _RIDGE * np.eye(knots)
    return matrix


@dataclass(frozen=True, slots=True)
class Regression:
    """Sums of a weighted least-squares problem, for each recording.

    Attributes:
        gram: (recordings, p, p) Gram matrices of the responses.
        moment: (recordings, p) inner products of responses and residual.
        square: (recordings,) squared residuals.
        lower: (p,) lower bounds of the coefficients; -inf for none.
        tables: number of tables, with p / tables knots each.
    """

    gram: FloatArray
    moment: FloatArray
    square: FloatArray
    lower: FloatArray
    tables: int = 1

    def fitted(self, strength: float, left_out: int | None = None) -> FloatArray:
        """(p,) coefficients from all recordings except ``left_out``, for a penalty strength."""
        gram, moment = self.gram.sum(axis=0), self.moment.sum(axis=0)
        normal = self.normal(strength)
        if left_out is not None:
            gram, moment = gram - self.gram[left_out], moment - self.moment[left_out]
            normal = normal - self.gram[left_out]
        return _solve_bounded(normal, moment, self.lower)

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
        """(recordings,) squared error of each recording with coefficients from the others."""
        each = range(len(self.square))
        return np.array([self.errors(self.fitted(strength, r), r) for r in each])


def _solve_bounded(normal: FloatArray, moment: FloatArray, lower: FloatArray) -> FloatArray:
    """Solution of normal equations with lower bounds, by an active-set method."""
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
    """Standard error of the sum of independent ``differences``; infinite for a single one."""
    n = len(differences)
    return float(np.sqrt(n) * np.std(differences, ddof=1)) if n > 1 else np.inf


def simplest_within_error(errors: Sequence[FloatArray]) -> int:
    """Index of the simplest model whose error is within one standard error of the smallest.

    This is the one-standard-error rule (Hastie, Tibshirani, Friedman, The Elements of Statistical
    Learning, sec. 7.10.1). Logarithms of errors are compared, so that all recordings count equally.

    Args:
        errors: (recordings,) squared errors of each model, the most complex model first.
    """
    best = int(np.argmin([e.sum() for e in errors]))
    for k in reversed(range(len(errors))):
        more = log_ratio(errors[k], errors[best])
        if k >= best and more.sum() <= standard_error(more):
            return k
    return best


def log_ratio(errors: FloatArray, others: FloatArray) -> FloatArray:
    """(recordings,) logarithm of the ratio of ``errors`` to ``others``, both squared errors."""
    ratio: FloatArray = np.log(np.maximum(errors, 1e-12)) - np.log(np.maximum(others, 1e-12))
    return ratio
