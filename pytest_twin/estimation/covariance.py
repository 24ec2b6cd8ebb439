"""Covariances of estimates: planned motions, blocks of correlated residuals, few samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.record_fields import Z95

JACKKNIFE_BLOCKS = 8
"""Number of blocks of neighbouring observations of a jackknife. Fewer, longer blocks allow for
longer correlations, but Student's quantile widens the interval: 2.36 with 8 blocks, 2.78 with 5."""
ENOUGH_RECORDINGS = 10
"""Smallest number of recordings for which each recording is one block of a bootstrap."""
_BLOCKS = 20
"""Number of blocks for fewer recordings."""
_RESAMPLES = 500
"""Number of bootstrap resamples."""
_CORRELATED = 0.9
"""Correlation from which a pair of parameters is reported."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted covariance of a motion.

    Attributes:
        covariance: (b, b) covariance of the base parameters, in their units; ``inf`` on the
            diagonal for parameters that the motion does not excite.
        undetermined: (b,) True for parameters that the motion does not determine.
        condition: condition number of the weighted regressor with unit columns.
    """

    covariance: FloatArray
    undetermined: NDArray[np.bool_]
    condition: float

    @property
    def std(self) -> FloatArray:
        """(b,) standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


LARGEST_CONDITION = 1e7
"""Largest ratio of singular values of the weighted regressor with unit columns. Directions with
smaller singular values are undetermined: an error of 1e-7 in the geometry would change their value
completely."""


def predicted_covariance(matrix: FloatArray, effort_std: FloatArray) -> Prediction:
    """Predict the covariance of weighted least squares: (sum W^T diag(1 / std^2) W)^-1.

    Args:
        matrix: (n, joints, b) base columns at n instants of the motion, one for each independent
            sample of the noise (after decimation to its bandwidth).
        effort_std: (joints,) standard deviation of the effort's noise at one sample, N*m or N.
    """
    weighted = (np.asarray(matrix) / np.asarray(effort_std)[:, None]).reshape(
        -1, np.shape(matrix)[-1]
    )
    sizes = np.linalg.norm(weighted, axis=0)
    moved = sizes > sizes.max(initial=0.0) / LARGEST_CONDITION
    scaled = weighted[:, moved] / sizes[moved]
    # The triangle has the same singular values and directions.
    triangle = np.linalg.qr(scaled, mode="r")
    _, singular, directions = np.linalg.svd(triangle, full_matrices=False)
    if not len(singular):
        count = weighted.shape[1]
        open_ = np.ones(count, dtype=bool)
        return Prediction(np.diag(np.full(count, np.inf)), open_, np.inf)
    good = singular > singular[0] / LARGEST_CONDITION
    # A parameter is undetermined if it has a component in an undetermined direction.
    part = np.sqrt(np.sum(directions[~good] ** 2, axis=0))
    undetermined = ~moved
    undetermined[np.flatnonzero(moved)[part > 1e-3]] = True
    inverse = (directions[good].T / singular[good] ** 2) @ directions[good]
    covariance = np.zeros((weighted.shape[1], weighted.shape[1]))
    at = np.ix_(moved, moved)
    covariance[at] = inverse / np.outer(sizes[moved], sizes[moved])
    covariance[undetermined] = 0.0
    covariance[:, undetermined] = 0.0
    covariance[undetermined, undetermined] = np.inf
    return Prediction(covariance, undetermined, float(singular[0] / max(singular[-1], 1e-300)))


def bootstrap_deviations(matrices: FloatArray, rights: FloatArray) -> FloatArray:
    """(b,) standard deviation of the solutions over resamples of the blocks."""
    blocks, count = rights.shape
    if blocks < 2 or not count:
        return np.zeros(count)
    # Columns have unit length, and the seed is fixed: the same recordings give the same result.
    sizes = np.sqrt(np.maximum(np.abs(np.einsum("kbb->b", matrices)), 1e-300))
    weights = np.random.default_rng(0).exponential(size=(_RESAMPLES, blocks))
    sums = np.einsum("rk,kbc->rbc", weights, matrices / np.outer(sizes, sizes))
    found = np.linalg.solve(sums, np.einsum("rk,kb->rb", weights, rights / sizes)[..., None])
    spread = found[..., 0].std(axis=0) * np.sqrt(blocks / (blocks - 1.0))
    return np.asarray(spread / sizes)


def block_of(lengths: Sequence[int]) -> NDArray[np.intp]:
    """(n,) block of each row: its recording, or equal parts if there are few recordings."""
    parts = 1 if len(lengths) >= ENOUGH_RECORDINGS else -(-_BLOCKS // len(lengths))
    owners, first = [], 0
    for n in lengths:
        own = min(parts, n)
        owners.append(first + np.arange(n) * own // max(n, 1))
        first += own
    return np.concatenate(owners).astype(np.intp)


def block_jackknife(
    slopes: FloatArray, residuals: FloatArray, prior: FloatArray
) -> tuple[FloatArray, float]:
    """Covariance (p, p), and half width of a 95 % interval in standard deviations.

    Each block of neighbouring observations is left out in turn, to first order (moving blocks;
    Künsch: The jackknife and the bootstrap for general stationary observations, 1989).

    Args:
        slopes: (n, k, p) derivatives of the residuals, in the order of the path.
        residuals: (n, k) residuals; both are divided by the noise.
        prior: (p, p) information matrix of the priors.

    Raises:
        numpy.linalg.LinAlgError: without one of the blocks an unknown is not determined.
    """
    count, _, unknowns = slopes.shape
    length = max(count // JACKKNIFE_BLOCKS, 1)
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


def small_sample_factor(count: int, deviations: float = Z95) -> float:
    """Return the factor by which an interval is widened for a small number of samples.

    The variance of resamples of n samples is too small by ``(n - 1) / n``, and the variance from
    few samples is itself uncertain. The factor includes both, with Student's quantile over the
    normal one of the same probability.

    Args:
        count: number of samples, at least two.
        deviations: half width of the interval for many samples, in standard deviations.
    """
    wide = float(student.ppf(norm.cdf(deviations), count - 1)) / deviations
    return wide * float(np.sqrt(count / (count - 1)))


def correlated_pairs(names: Sequence[str], covariance: np.ndarray) -> list[dict[str, Any]]:
    """Return pairs of strongly correlated parameters."""
    std = np.sqrt(np.diag(covariance).clip(1e-300))
    correlation = covariance / np.outer(std, std)
    found = []
    for i in range(len(names)):
        for k in range(i):
            if abs(correlation[i, k]) >= _CORRELATED:
                found.append(
                    {"pair": [names[k], names[i]], "correlation": float(correlation[i, k])}
                )
    return sorted(found, key=lambda one: -abs(one["correlation"]))
