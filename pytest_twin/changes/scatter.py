"""How much the recordings of an unchanged robot differ from each other.

A model never explains an effort completely, and what it leaves is no noise that averages out: it
differs from recording to recording with the motion, the temperature and the load. So the amplitude
of every law deviates from recording to recording, and its variance is estimated (variance
components by expectation maximization: Dempster, Laird, Rubin, J. R. Stat. Soc. B 39, 1977;
Kennedy and O'Hagan, J. R. Stat. Soc. B 63, 2001, for the model error). A longer recording then is
not more evidence of a change, another recording is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor
from scipy.linalg.lapack import dpotri

from pytest_twin.arrays import FloatArray

AMPLITUDE_PRIOR = 0.1
"""Standard deviation of an amplitude and of its change before any recording: its effort relative to
the RMS effort of the joint. Chosen on Baxter: up to 0.3 the share of right first names changes by
3 points, and at 0.1 it is largest."""
_PRIOR_SESSIONS = 2.0
"""Number of sessions that the prior of a variance counts as (inverse gamma law)."""
_PRIOR_DEVIATION = 0.03
"""Deviation of an amplitude between sessions before any recording, relative to the noise of the
joint. It is small, so that the recordings decide. Chosen on Baxter between 0.003 and 0.3: at r = 1
the first name was right in 79 % at 0.01, 80 % at 0.03 and 69 % at 0.1."""
_ITERATIONS = 6
"""Number of steps of the expectation maximization; the scores then change by less than their
scatter."""
_FIRST_NOISE = 0.1
"""Noise relative to the RMS effort with which the estimates begin."""
_LEAST_NOISE = 1e-4
"""Smallest noise relative to the RMS effort: simulated recordings have none."""


@dataclass(frozen=True)
class SessionSums:
    """Sums over the rows of one joint in one session.

    Attributes:
        columns: (k,) indices of the columns that act on the joint, ascending.
        matrix: (k, k) sums of products of scaled columns, (N*m)^2 or N^2.
        vector: (k,) sums of products of columns and effort.
        power: sum of squared efforts.
        samples: number of rows.
    """

    columns: NDArray[np.intp]
    matrix: FloatArray
    vector: FloatArray
    power: float
    samples: int

    @classmethod
    def total(cls, parts: Sequence[SessionSums]) -> SessionSums:
        """Sums over several recordings."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            parts[0].columns,
            np.sum([part.matrix for part in parts], axis=0),
            np.sum([part.vector for part in parts], axis=0),
            sum(part.power for part in parts),
            sum(part.samples for part in parts),
        )


_FREE = 10.0
"""Standard deviation of an amplitude that is free, relative to the RMS effort."""
INDEPENDENT = 0.8
"""Independent values per row: rows have 2.5 times the rate of their bandwidth, and a band-limited
signal has two independent values for each period of its bandwidth (Shannon)."""


@dataclass(frozen=True)
class Scatter:
    """Scatter of one joint.

    Attributes:
        noise: variance of a row, (N*m)^2 or N^2.
        deviation: (k,) variance of each amplitude between sessions, relative to the RMS effort.
    """

    noise: float
    deviation: FloatArray

    def spread(self, sums: SessionSums) -> FloatArray:
        """(k, k) covariance of the deviations of a session, given its rows."""
        return _inverse(sums.matrix / self.noise + np.diag(1.0 / self.deviation))

    def information(
        self, sums: SessionSums, spread: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """(k, k) information of a session and (k,) right side, its deviations marginalized."""
        spread = self.spread(sums) if spread is None else spread
        weighted = sums.matrix / self.noise
        gain = weighted @ spread
        return weighted - gain @ weighted, (sums.vector - gain @ sums.vector) / self.noise

    def lack_of_fit(self, sums: SessionSums) -> float:
        """Variance of a session's rows that all laws together leave, relative to the noise.

        Every amplitude is free, so it is large only where no law describes the
        effort. The amplitudes that the rows determine are no independent values.
        """
        weighted = sums.matrix / self.noise
        shrunk = _inverse(weighted + np.eye(len(weighted)) / _FREE**2)
        amplitudes = shrunk @ sums.vector / self.noise
        power = sums.power - 2.0 * float(sums.vector @ amplitudes)
        power += float(amplitudes @ sums.matrix @ amplitudes)
        left = INDEPENDENT * sums.samples - float(np.sum(shrunk * weighted))
        return INDEPENDENT * power / max(left, 1.0) / self.noise


def scatter_of(
    earlier: Sequence[SessionSums], later: Sequence[SessionSums], size: float
) -> Scatter:
    """Estimate the scatter of one joint from the differences within two groups of sessions.

    Whatever changed between the groups is free, so it is no scatter.

    Args:
        earlier, later: sums of each session.
        size: RMS effort of the joint, N*m or N.
    """
    count = len(earlier[0].columns)
    least = (_LEAST_NOISE * size) ** 2
    noise = max((_FIRST_NOISE * size) ** 2, least)
    scatter = Scatter(noise, _prior_variance(noise, size, count))
    for _ in range(_ITERATIONS):
        scatter = _step(scatter, earlier, later, size, least)
    return scatter


def _prior_variance(noise: float, size: float, count: int) -> FloatArray:
    return np.full(count, _PRIOR_DEVIATION**2 * noise / size**2)


def _step(
    scatter: Scatter,
    earlier: Sequence[SessionSums],
    later: Sequence[SessionSums],
    size: float,
    least: float,
) -> Scatter:
    """One step of the expectation maximization."""
    count = len(scatter.deviation)
    every = [*earlier, *later]
    spreads = [scatter.spread(sums) for sums in every]
    shown = [scatter.information(sums, spread) for sums, spread in zip(every, spreads, strict=True)]
    groups = [slice(0, len(earlier)), slice(len(earlier), len(every))]
    means, covariances = _group_means(shown, groups, count)
    squares, power, samples = np.zeros(count), 0.0, 0
    for group, mean, covariance in zip(groups, means, covariances, strict=True):
        for sums, spread in zip(every[group], spreads[group], strict=True):
            pull = spread @ sums.matrix / scatter.noise
            deviation = spread @ (sums.vector - sums.matrix @ mean) / scatter.noise
            squares += deviation**2 + np.diag(spread)
            squares += np.einsum("ab,ab->a", pull @ covariance, pull)
            amplitudes = mean + deviation
            unmoved = np.eye(count) - pull
            uncertain = spread + unmoved @ covariance @ unmoved.T
            power += sums.power - 2.0 * float(sums.vector @ amplitudes)
            power += float(amplitudes @ sums.matrix @ amplitudes + np.sum(sums.matrix * uncertain))
            samples += sums.samples
    noise = max(power / max(samples, 1), least)
    prior = _prior_variance(noise, size, count)
    deviations = (_PRIOR_SESSIONS * prior + squares) / (_PRIOR_SESSIONS + len(every))
    return Scatter(noise, np.minimum(deviations, AMPLITUDE_PRIOR**2))


def _group_means(
    shown: Sequence[tuple[FloatArray, FloatArray]], groups: Sequence[slice], count: int
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Mean amplitudes of the earlier and of the later sessions, with their covariances.

    The later mean is the earlier one and a change, each with the prior of an amplitude.
    """
    prior = np.eye(count) / AMPLITUDE_PRIOR**2
    (old, old_vector), (new, new_vector) = (
        (
            np.sum([matrix for matrix, _ in shown[group]], axis=0),
            np.sum([vector for _, vector in shown[group]], axis=0),
        )
        for group in groups
    )
    precision = np.block([[old + new + prior, new], [new, new + prior]])
    covariance = _inverse(precision)
    both = covariance @ np.concatenate([old_vector + new_vector, new_vector])
    before, change = both[:count], both[count:]
    of_before = covariance[:count, :count]
    cross = covariance[:count, count:]
    of_later = of_before + cross + cross.T + covariance[count:, count:]
    return [before, before + change], [of_before, of_later]


def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a positive definite matrix; a Cholesky factor takes half the time of LU."""
    factor, _ = cho_factor(matrix, lower=True, check_finite=False)
    inverse, failed = dpotri(factor, lower=True, overwrite_c=True)
    if failed:
        return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    lower = np.tril(inverse)
    return np.asarray(lower + np.tril(inverse, -1).T, dtype=np.float64)
