"""Essential parameters: base parameters that differ significantly from zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.least_squares import (
    LinearProblem,
    Solution,
    information,
    solve,
)

SIGNIFICANT = 4.0
"""Distance from zero, in standard deviations, below which a parameter is not essential. On the
TX40, 3 keeps 28 of 61 parameters, 4 keeps 26 and 5 keeps 24; 4 has the smallest held-out error."""

_PARTS = 10
"""Number of parts of a cross-validation."""


@dataclass(frozen=True)
class EssentialParameters:
    """Fit of the essential parameters.

    Attributes:
        kept: (k,) indices of the fitted columns.
        held: (b - k,) indices of the others, which are fixed at zero.
        solution: fit of the kept columns.
    """

    kept: NDArray[np.intp]
    held: NDArray[np.intp]
    solution: Solution

    @property
    def values(self) -> FloatArray:
        """(b,) all parameters, zero where they are not essential."""
        whole = np.zeros(len(self.kept) + len(self.held))
        whole[self.kept] = self.solution.values
        return whole


def find_essential_parameters(problem: LinearProblem) -> EssentialParameters:
    """Backward elimination of parameters that do not differ from zero (Khalil, Dombre 2002, 12.5).

    Of the parameters that qualify, in their order, as many are left out as cross-validation allows:
    the predicted error of no joint may rise by more than its standard error.

    Args:
        problem: problem with independent columns.
    """
    kept = np.arange(problem.matrix.shape[2])
    while True:
        rest = problem.only(kept)
        found = solve(rest)
        removed = _eliminate(rest, found)
        removed = removed[: _allowed_removals(rest, found, removed)]
        if not removed:
            held = np.setdiff1d(np.arange(problem.matrix.shape[2]), kept)
            half = np.hypot(found.half_width, Z95 * omission(problem, kept, held, found))
            return EssentialParameters(kept, held, replace(found, half_width=half))
        kept = np.delete(kept, removed)


def _allowed_removals(problem: LinearProblem, found: Solution, removed: Sequence[int]) -> int:
    """Return how many of the parameters may be removed, in order, by cross-validation.

    Each part of the recordings is predicted by the fit of the others. Parts are interleaved, so
    that the others contain every recording: one that alone excites a joint is never missing.
    Compared is the sum of squares of each joint and of all, with the set of the smallest sum.

    Args:
        problem: rows and columns.
        found: fit of all columns, whose weights are used.
        removed: columns in the order of their removal.
    """
    if not removed:
        return 0
    part = np.concatenate([np.arange(n) * _PARTS // max(n, 1) for n in problem.lengths])
    joints = problem.matrix.shape[1]
    count = problem.matrix.shape[2]
    grams = np.zeros((_PARTS, joints, count + 1, count + 1))
    sizes = np.linalg.norm(problem.matrix * found.weight[..., None], axis=(0, 1)).clip(1e-300)
    for k in range(_PARTS):
        for j in range(joints):
            rows = part == k
            both = np.column_stack([problem.matrix[rows, j] / sizes, problem.effort[rows, j]])
            weighted = both * found.weight[rows, j, None]
            grams[k, j] = weighted.T @ weighted
    whole = grams.sum(axis=(0, 1))
    errors = []
    for number in range(len(removed) + 1):
        kept = np.setdiff1d(np.arange(count), removed[:number])
        with_effort = np.append(kept, count)
        squares = np.zeros((_PARTS, joints))
        for k in range(_PARTS):
            others = whole - grams[k].sum(axis=0)
            square, right = others[np.ix_(kept, kept)], others[kept, count]
            residual = np.append(-np.linalg.lstsq(square, right, rcond=1e-12)[0], 1.0)
            own = grams[k][:, with_effort][:, :, with_effort]
            squares[k] = residual @ own @ residual
        errors.append(np.column_stack([squares, squares.sum(axis=1)]))
    best = min(errors, key=lambda each: float(each[:, -1].sum()))
    for number in range(len(removed), 0, -1):
        rise = errors[number] - best
        standard_error = rise.std(axis=0, ddof=1) / np.sqrt(_PARTS)
        if (rise.mean(axis=0) <= standard_error).all():
            return number
    return 0


def _eliminate(problem: LinearProblem, found: Solution) -> list[int]:
    """Return the columns to remove, in order, with the weights of a solution."""
    said = information(problem, found.residual, found.weight)
    values = found.values.copy()
    kept = np.arange(len(values))
    removed: list[int] = []
    while len(kept):
        own = values[kept]
        std = np.sqrt(np.diag(said.covariance(kept)).clip(1e-300))
        least = int(np.argmin(np.abs(own) / std))
        if abs(own[least]) >= SIGNIFICANT * std[least]:
            break
        one = int(kept[least])
        removed.append(one)
        kept = np.delete(kept, least)
        # The other parameters follow the removed one to the new least-squares solution.
        block = said.matrix[np.ix_(kept, kept)]
        values[kept] += np.linalg.lstsq(block, said.matrix[kept, one] * values[one], rcond=None)[0]
    return removed


def shrinkage(t: FloatArray) -> float:
    """Factor s of estimates that may be noise: 0 if they are noise only, 1 if they are exact.

    Under Zellner's prior with the empirical width of George and Foster (Biometrika 87, 2000), the
    true values of estimates b with covariance C have mean s b and covariance s C.

    Args:
        t: (k,) estimates divided by their standard deviations.
    """
    return max(0.0, 1.0 - 1.0 / max(float(np.mean(t**2)), 1e-300)) if len(t) else 0.0


def omission(
    problem: LinearProblem, kept: NDArray[np.intp], held: NDArray[np.intp], found: Solution
) -> FloatArray:
    """(k,) RMS bias of the kept parameters that the omission of the others causes.

    The omitted-variable bias is A beta, with A = (W_k^T W_k)^-1 W_k^T W_h. The omitted parameters
    beta are those of the fit of all parameters, b with covariance C, shrunk by :func:`shrinkage`.

    Args:
        problem: problem with all columns.
        kept, held: indices of its columns.
        found: fit of the kept columns.
    """
    if not len(held) or not len(kept):
        return np.zeros(len(kept))
    said = information(problem, found.residual, found.weight)
    sizes = np.sqrt(np.maximum(np.diag(said.matrix), 1e-300))
    unit = np.outer(sizes, sizes)
    weighed = (found.residual * found.weight**2)[..., None] * problem.matrix
    step = np.linalg.pinv(said.matrix / unit, hermitian=True) @ (weighed.sum(axis=(0, 1)) / sizes)
    every = said.covariance(np.arange(len(sizes)))[np.ix_(held, held)]
    estimate = (step / sizes)[held]
    deviation = np.sqrt(np.maximum(np.diag(every), 1e-300))
    share = shrinkage(estimate / deviation)
    among = (said.matrix / unit)[np.ix_(kept, kept)]
    pull = np.linalg.pinv(among, hermitian=True) @ (said.matrix / unit)[np.ix_(kept, held)]
    pull = pull * sizes[held] / sizes[kept][:, None]
    bias = share * (pull @ estimate)
    spread = share * np.einsum("ij,jk,ik->i", pull, every, pull)
    return np.asarray(np.sqrt(bias**2 + np.maximum(spread, 0.0)))
