"""Weighted, robust least squares of the inverse dynamics, and what its parameters are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.evidence import effective_samples
from pytest_twin.diagnosis.intervals import clusters, jackknife
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.sampled import Sampled
from pytest_twin.identification.regressor import predicted_covariance
from pytest_twin.metrics.joint_covariance import upper_covariance

_ITERATIONS = 12
_SETTLED = 1e-4
_HUBER = 3.0
"""Standard deviations from which a residual counts by its amount and no more by its square: of
normal noise less than one in 300, so that the estimate loses no precision."""


@dataclass(frozen=True)
class Linear:
    """Rows of a linear problem, all recordings one after another.

    Attributes:
        matrix: (n, joints, b).
        effort: (n, joints), 0 where unknown.
        known: (n, joints) rows that count.
        resting: (n, joints) where dry friction has no direction.
        dry: (joints, b) which columns are the dry friction of a joint.
        lengths: rows of each recording.
        instrument: (n, joints, b) the same columns along a motion without noise; None without one.
    """

    matrix: FloatArray
    effort: FloatArray
    known: NDArray[np.bool_]
    resting: NDArray[np.bool_]
    dry: NDArray[np.bool_]
    lengths: tuple[int, ...]
    instrument: FloatArray | None = None

    def only(self, columns: NDArray[np.intp]) -> Linear:
        """The problem with these columns alone."""
        return Linear(
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
    """What a fit found.

    Attributes:
        values: (b,) parameters.
        covariance: (b, b), for residuals that are correlated in time.
        noise: (joints,) standard deviation of the residual, N*m or N; NaN without any row.
        residual: (n, joints) measured minus predicted, 0 where unknown.
        weight: (n, joints) reciprocal deviations of the rows.
        condition: condition number of the weighted columns, each of unit length.
        half_width: (b,) of the 95 % interval.
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


def linear(samples: Sequence[Sampled], columns: NDArray[np.intp], dry: NDArray[np.bool_]) -> Linear:
    """The problem of some recordings.

    Args:
        samples: the recordings.
        columns: (b,) indices of the regressor's columns.
        dry: (joints, b) which of these are the dry friction of a joint.
    """
    effort = np.concatenate([s.effort for s in samples])
    known = np.isfinite(effort) & ~np.concatenate([s.saturated for s in samples])
    instruments = [s.instrument[..., columns] for s in samples if s.instrument is not None]
    return Linear(
        np.concatenate([s.matrix[..., columns] for s in samples]),
        np.where(known, effort, 0.0),
        known,
        np.concatenate([s.resting for s in samples]),
        dry,
        tuple(len(s.time) for s in samples),
        np.concatenate(instruments) if len(instruments) == len(samples) else None,
    )


def moved_by(columns: FloatArray, problem: Linear) -> NDArray[np.bool_]:
    """(b,) parameters that a motion determines, whatever the noise.

    Args:
        columns: (n, joints, b) of the problem along that motion.
        problem: whose efforts are known.
    """
    size = np.sqrt(np.sum(problem.effort**2, axis=0) / np.maximum(problem.known.sum(axis=0), 1))
    rows = np.where(problem.known[..., None], columns, 0.0)
    return ~predicted_covariance(rows, np.where(size > 0, size, 1.0)).undetermined


def solve(problem: Linear, *, intervals: bool = True) -> Solution:
    """Iteratively reweighted least squares: each joint by its own residual, outliers less.

    A joint at rest tells the rest of its effort only within its dry friction, so that its rows have
    that variance too. The weight of outliers is Huber's (Annals of Mathematical Statistics 35,
    1964).

    Args:
        problem: rows and columns; columns must be independent.
        intervals: whether covariance and intervals are wanted.
    """
    count = problem.matrix.shape[2]
    weight = np.where(problem.known, 1.0, 0.0)
    scale = np.sqrt(np.sum(problem.effort**2, axis=0) / np.maximum(problem.known.sum(axis=0), 1))
    weight /= np.maximum(scale, 1e-12)
    values: FloatArray = np.zeros(count)
    for _ in range(_ITERATIONS):
        before = values
        rows = weighed(problem.matrix, weight)
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


def weighed(columns: FloatArray, weight: FloatArray) -> FloatArray:
    """(n joints, b) rows of (n, joints, b) columns times (n, joints) weights; b may be 0."""
    instants, joints, count = columns.shape
    return np.asarray((columns * weight[..., None]).reshape(instants * joints, count))


def row_weights(
    problem: Linear, residual: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Reciprocal deviations of every row, and each joint's noise while it moves."""
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


def dry_levels(problem: Linear, values: FloatArray) -> FloatArray:
    """(joints,) dry friction of each joint under some parameters, N*m or N."""
    return np.array([np.abs(values[own]).sum() for own in problem.dry])


def deviations(resting: NDArray[np.bool_], noise: FloatArray, dry: FloatArray) -> FloatArray:
    """(n, joints) standard deviation of a residual: the noise, and at rest the dry friction, which
    is anywhere between its two directions.
    """
    return np.sqrt(noise**2 + np.where(resting, dry**2 / 3.0, 0.0))


@dataclass(frozen=True)
class Information:
    """What weighted rows say of the parameters.

    Attributes:
        matrix: (b, b) sum of W^T W over all weighted rows.
        enlarged: (b, b) the same, each joint times how many samples one independent one is.
    """

    matrix: FloatArray
    enlarged: FloatArray

    def covariance(self, columns: NDArray[np.intp]) -> FloatArray:
        """(k, k) of the parameters of these columns, the others held."""
        own = self.matrix[np.ix_(columns, columns)]
        sizes = np.sqrt(np.maximum(np.diag(own), 1e-300))
        unit = np.outer(sizes, sizes)
        inverse = np.linalg.pinv(own / unit, hermitian=True) / unit
        return np.asarray(inverse @ self.enlarged[np.ix_(columns, columns)] @ inverse)


def information(problem: Linear, residual: FloatArray, weight: FloatArray) -> Information:
    """What the rows of a problem say under its weights.

    Residuals are correlated in time, and each joint's rows count as its effective samples (Geyer
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
    problem: Linear, residual: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariance for correlated residuals, and half widths that leaving out recordings bears out.

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
        rows = weighed(problem.matrix[mine], weight[mine])
        scores.append(rows.T @ (residual[mine] * weight[mine]).ravel())
        parts.append(rows.T @ rows)
    left_out = jackknife(np.array(scores), np.array(parts))
    half = np.maximum(Z95 * np.sqrt(np.diag(covariance).clip(0.0)), np.sqrt(np.diag(left_out)))
    return upper_covariance(covariance, left_out / Z95**2), half
