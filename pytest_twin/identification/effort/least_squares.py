"""Weighted, robust least squares of the inverse dynamics, with the parameters' covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.intervals import clusters, jackknife
from pytest_twin.estimation.score import effective_samples
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.recording_rows import RecordingRows
from pytest_twin.identification.regressor import predicted_covariance
from pytest_twin.metrics.joint_covariance import upper_covariance

_ITERATIONS = 12
"""Largest number of iterations of the weights."""
_SETTLED = 1e-4
"""Change of the parameters, relative to the largest one, below which the iterations end."""
_HUBER = 3.0
"""Number of standard deviations above which a residual enters the cost linearly (Huber). Less than
one in 300 normal residuals exceeds it, so the estimate loses no precision."""


@dataclass(frozen=True)
class LinearProblem:
    """Linear problem; rows of all recordings are concatenated.

    Attributes:
        matrix: (n, joints, b) regressor.
        effort: (n, joints) N*m or N, 0 where unknown.
        known: (n, joints) True for rows that are used.
        resting: (n, joints) True where the joint is at rest and dry friction has no direction.
        dry: (joints, b) True for columns that are dry friction of a joint.
        lengths: number of rows of each recording.
        instrument: (n, joints, b) the same columns for a noise-free motion; None without one.
    """

    matrix: FloatArray
    effort: FloatArray
    known: NDArray[np.bool_]
    resting: NDArray[np.bool_]
    dry: NDArray[np.bool_]
    lengths: tuple[int, ...]
    instrument: FloatArray | None = None

    def only(self, columns: NDArray[np.intp]) -> LinearProblem:
        """Return the problem with these columns only."""
        return LinearProblem(
            self.matrix[..., columns],
            self.effort,
            self.known,
            self.resting,
            self.dry[:, columns],
            self.lengths,
            None if self.instrument is None else self.instrument[..., columns],
        )


@dataclass(frozen=True)
class Solution:
    """Result of a fit.

    Attributes:
        values: (b,) parameters.
        covariance: (b, b) covariance, for residuals correlated in time.
        noise: (joints,) standard deviation of the residual, N*m or N; NaN without any row.
        residual: (n, joints) measured minus predicted, 0 where unknown.
        weight: (n, joints) reciprocal standard deviations of the rows.
        condition: condition number of the weighted columns, normalized to unit length.
        half_width: (b,) half widths of the 95 % intervals.
    """

    values: FloatArray
    covariance: FloatArray
    noise: FloatArray
    residual: FloatArray
    weight: FloatArray
    condition: float
    half_width: FloatArray

    @property
    def std(self) -> FloatArray:
        """(b,) standard deviations."""
        return np.asarray(self.half_width / Z95)


def linear_problem(
    samples: Sequence[RecordingRows], columns: NDArray[np.intp], dry: NDArray[np.bool_]
) -> LinearProblem:
    """Build the linear problem of recordings.

    Args:
        columns: (b,) indices of the regressor's columns.
        dry: (joints, b) True for those that are dry friction of a joint.
    """
    effort = np.concatenate([s.effort for s in samples])
    known = np.isfinite(effort) & ~np.concatenate([s.saturated for s in samples])
    instruments = [s.instrument[..., columns] for s in samples if s.instrument is not None]
    return LinearProblem(
        np.concatenate([s.matrix[..., columns] for s in samples]),
        np.where(known, effort, 0.0),
        known,
        np.concatenate([s.resting for s in samples]),
        dry,
        tuple(len(s.time) for s in samples),
        np.concatenate(instruments) if len(instruments) == len(samples) else None,
    )


def is_determined(columns: FloatArray, problem: LinearProblem) -> NDArray[np.bool_]:
    """(b,) True for parameters that a motion determines, for any noise.

    Args:
        columns: (n, joints, b) regressor of that motion.
        problem: problem that states which efforts are known.
    """
    size = np.sqrt(np.sum(problem.effort**2, axis=0) / np.maximum(problem.known.sum(axis=0), 1))
    rows = np.where(problem.known[..., None], columns, 0.0)
    return ~predicted_covariance(rows, np.where(size > 0, size, 1.0)).undetermined


def solve(problem: LinearProblem, *, intervals: bool = True) -> Solution:
    """Solve by iteratively reweighted least squares, with noise per joint and robust weights.

    The effort of a joint at rest is uncertain by its dry friction, so the variance of its rows
    includes the friction. Outliers have Huber's weights (Annals of Mathematical Statistics 35,
    1964).

    Args:
        problem: rows and columns; columns must be independent.
        intervals: whether to compute covariance and intervals.
    """
    count = problem.matrix.shape[2]
    weight = np.where(problem.known, 1.0, 0.0)
    scale = np.sqrt(np.sum(problem.effort**2, axis=0) / np.maximum(problem.known.sum(axis=0), 1))
    weight /= np.maximum(scale, 1e-12)
    values: FloatArray = np.zeros(count)
    for _ in range(_ITERATIONS):
        before = values
        rows = weight_rows(problem.matrix, weight)
        # The triangle has the same solution and at most as many rows as columns.
        both = np.column_stack([rows, (problem.effort * weight).ravel()])
        triangle = np.asarray(np.linalg.qr(both, mode="r"), dtype=np.float64).reshape(-1, count + 1)
        found = np.linalg.lstsq(triangle[:, :count], triangle[:, count], rcond=None)[0]
        values = np.asarray(found, dtype=np.float64)
        residual = np.where(problem.known, problem.effort - problem.matrix @ values, 0.0)
        weight, noise = row_weights(problem, residual, values)
        if np.all(np.abs(values - before) <= _SETTLED * np.abs(values).max(initial=0.0)):
            break
    sizes = np.linalg.norm(triangle[:, :count], axis=0)
    unit = triangle[:, :count] / np.maximum(sizes, 1e-300)
    singular: FloatArray = np.linalg.svd(unit, compute_uv=False)
    condition = float(singular[0] / max(singular[-1], 1e-300)) if count else 1.0
    if not intervals or not count:
        empty = np.zeros((count, count))
        return Solution(values, empty, noise, residual, weight, condition, np.zeros(count))
    covariance, half = _uncertainty(problem, residual, weight)
    return Solution(values, covariance, noise, residual, weight, condition, half)


def weight_rows(columns: FloatArray, weight: FloatArray) -> FloatArray:
    """(n joints, b) rows of (n, joints, b) columns times (n, joints) weights; b may be 0."""
    instants, joints, count = columns.shape
    return np.asarray((columns * weight[..., None]).reshape(instants * joints, count))


def row_weights(
    problem: LinearProblem, residual: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return reciprocal standard deviations of every row, and each joint's noise while moving."""
    count = residual.shape[1]
    noise = np.full(count, np.nan)
    for j in range(count):
        moving = problem.known[:, j] & ~problem.resting[:, j]
        use = moving if moving.any() else problem.known[:, j]
        if use.any():
            noise[j] = max(float(np.sqrt(np.mean(residual[use, j] ** 2))), 1e-12)
    deviation = deviations(problem.resting, noise, dry_levels(problem, values))
    robust = np.sqrt(np.minimum(1.0, _HUBER * deviation / np.maximum(np.abs(residual), 1e-300)))
    known = problem.known & np.isfinite(deviation)
    return np.where(known, robust / np.where(known, deviation, 1.0), 0.0), noise


def dry_levels(problem: LinearProblem, values: FloatArray) -> FloatArray:
    """(joints,) dry friction of each joint for given parameters, N*m or N."""
    return np.array([np.abs(values[own]).sum() for own in problem.dry])


def deviations(resting: NDArray[np.bool_], noise: FloatArray, dry: FloatArray) -> FloatArray:
    """(n, joints) standard deviations of residuals: noise and, at rest, dry friction.

    At rest, dry friction has any value between its two directions.
    """
    return np.sqrt(noise**2 + np.where(resting, dry**2 / 3.0, 0.0))


@dataclass(frozen=True)
class Information:
    """Information matrices of weighted rows.

    Attributes:
        matrix: (b, b) sum of W^T W over all weighted rows.
        enlarged: (b, b) the same sum, with each joint multiplied by its number of samples per
            independent sample.
    """

    matrix: FloatArray
    enlarged: FloatArray

    def covariance(self, columns: NDArray[np.intp]) -> FloatArray:
        """(k, k) covariance of the parameters of these columns, with the others fixed.

        Combinations that the rows determine only by rounding have large finite variances.
        """
        own = self.matrix[np.ix_(columns, columns)]
        sizes = np.sqrt(np.maximum(np.diag(own), 1e-300))
        unit = np.outer(sizes, sizes)
        rounding = len(columns) * np.finfo(np.float64).eps * np.eye(len(columns))
        inverse = np.linalg.inv(own / unit + rounding)
        enlarged = self.enlarged[np.ix_(columns, columns)] / unit + rounding
        return np.asarray(inverse @ enlarged @ inverse / unit)


def information(problem: LinearProblem, residual: FloatArray, weight: FloatArray) -> Information:
    """Return the information matrices of a problem with given weights.

    Residuals are correlated in time, so the effective sample size of each joint is used (Geyer
    1992).
    """
    effective = np.maximum(effective_samples(residual, problem.lengths), 2.0)
    enlarged = np.maximum(len(residual) / effective, 1.0)
    count = problem.matrix.shape[2]
    whole, wide = np.zeros((count, count)), np.zeros((count, count))
    for j in range(residual.shape[1]):
        rows = problem.matrix[:, j] * weight[:, j, None]
        own = rows.T @ rows
        whole += own
        wide += enlarged[j] * own
    return Information(whole, wide)


def _uncertainty(
    problem: LinearProblem, residual: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance for correlated residuals, and half widths checked by a jackknife.

    The white-noise covariance is enlarged by each joint's effective samples (Geyer 1992). The half
    width is at least that of the jackknife over recordings, or over parts of few ones.
    """
    count = problem.matrix.shape[2]
    said = information(problem, residual, weight)
    covariance = said.covariance(np.arange(count))
    owner = clusters(list(range(len(problem.lengths))), problem.lengths)
    scores, parts = [], []
    for k in range(int(owner.max()) + 1):
        mine = owner == k
        rows = weight_rows(problem.matrix[mine], weight[mine])
        scores.append(rows.T @ (residual[mine] * weight[mine]).ravel())
        parts.append(rows.T @ rows)
    left_out = jackknife(np.array(scores), np.array(parts))
    half = np.maximum(Z95 * np.sqrt(np.diag(covariance).clip(0.0)), np.sqrt(np.diag(left_out)))
    return upper_covariance(covariance, left_out / Z95**2), half


def widened(problem: LinearProblem, solution: Solution, slopes: FloatArray) -> Solution:
    """Return the solution with the uncertainty of quantities that it takes as given.

    Args:
        problem: problem with the columns of the solution.
        slopes: (n, joints, k) change of the efforts by one standard deviation of each quantity.
    """
    rows = weight_rows(problem.matrix, solution.weight)
    change = np.linalg.lstsq(rows, weight_rows(slopes, solution.weight), rcond=None)[0]
    carried = change @ change.T
    return replace(
        solution,
        covariance=solution.covariance + carried,
        half_width=np.hypot(solution.half_width, Z95 * np.sqrt(np.diag(carried))),
    )
