"""How well parameters are known: intervals that hold where residuals are correlated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.evidence import effective_samples
from pytest_twin.diagnosis.fit import Fitted
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.base import SMOOTH_STEP

_LEVEL = 0.975
# A combination of parameters is taken to be known ten times better than each of them at most.
_LEAST_VARIANCE = 0.01


@dataclass(frozen=True, slots=True)
class Spread:
    """How far the parameters of a fit may be off.

    Attributes:
        half_width: (parameters,) of the 95 % interval, in multiples of the parameters' scales.
        correlation: (parameters, parameters).
        covariance: (parameters, parameters), scaled parameters.
        quantile: of Student's distribution that the half widths carry.
    """

    half_width: FloatArray
    correlation: FloatArray
    covariance: FloatArray
    quantile: float

    def apart(self, which: NDArray[np.int64], offset: FloatArray) -> float:
        """How far a fit is from ``offset`` off it: 1 on the edge of a joint 95 % region.

        What trades off may be known together where each is not (Wald's test).

        Args:
            which: (n,) indices of parameters.
            offset: (n,) from the fit, in multiples of the scales.
        """
        scaled = offset / np.maximum(self.half_width[which], 1e-300)
        values, vectors = np.linalg.eigh(self.correlation[np.ix_(which, which)])
        square = np.sum((vectors.T @ scaled) ** 2 / np.maximum(values, _LEAST_VARIANCE))
        one, together = (float(stats.chi2.ppf(2.0 * _LEVEL - 1.0, n)) for n in (1, len(which)))
        return float(np.sqrt(square * one / together))


def spread(problem: Problem, fitted: Fitted) -> Spread:
    """Intervals from the curvature at the optimum.

    Residuals are correlated in time, and no model is quite right. Three estimates of what that
    costs stand side by side, and the widest counts: the sandwich with a Bartlett kernel (Newey,
    West, Econometrica 55, 1987) over the scores, the white-noise covariance enlarged to the
    effective samples (Geyer 1992), and, from three recordings on, how far these disagree
    (scores clustered by recording, Liang, Zeger, Biometrika 73, 1986, with Student's quantile of
    as many degrees as there are recordings less one). What
    the correction of the simulator's step leaves is added: it is no chance, but the parameters are
    off by it. Where a parameter moves the simulation in leaps it is known no finer than these.
    """
    count = fitted.hypothesis.theta.size
    if not count:
        return Spread(np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0)), 0.0)
    residual, floor = fitted.residual, problem.signal_floor
    mean_square = np.maximum(np.mean(residual**2, axis=0), floor**2)
    weight = 1.0 / mean_square
    lengths = problem.lengths(problem.fit)
    effective = np.maximum(effective_samples(residual, lengths), 2.0)
    jac = fitted.jacobian
    curvature = np.einsum("tsp,s,tsq->pq", jac, weight, jac)
    inverse = _inverse(curvature)
    enlarged = np.einsum("tsp,s,tsq->pq", jac, weight * len(residual) / effective, jac)
    scores = np.einsum("tsp,ts->tp", jac, residual * weight)
    ranges = 2.0 * len(residual) / effective
    meat = _long_run(scores, lengths, int(np.ceil(ranges.max())))
    wide = inverse @ enlarged @ inverse
    sandwich = inverse @ meat @ inverse
    deviation = np.sqrt(np.maximum(np.diag(wide), np.diag(sandwich)).clip(0.0))
    base = np.sqrt(np.diag(wide).clip(1e-300))
    correlation = wide / np.outer(base, base)
    freedom = max(float(effective.max()) * 1.0 - count, 2.0)
    quantile = float(stats.t.ppf(_LEVEL, freedom))
    shift = np.abs(inverse @ _discretization_pull(problem, jac, weight))
    half = np.maximum(quantile * deviation, _between_recordings(problem, scores, lengths, inverse))
    for i, p in enumerate(p for t in fitted.hypothesis.terms for p in t.parameters):
        if p.step > SMOOTH_STEP:
            shift[i] = max(shift[i], p.step)
    still = ~fitted.hypothesis.movable
    half[still] = shift[still] = 0.0
    return Spread(
        half + shift,
        correlation,
        correlation * np.outer(deviation, deviation),
        quantile,
    )


def _between_recordings(
    problem: Problem, scores: FloatArray, lengths: list[int], inverse: FloatArray
) -> FloatArray:
    """Half widths (parameters,) by how far whole recordings pull apart.

    Zero with fewer than three: of two, one degree of freedom is left, which says next to nothing.
    """
    owner = np.repeat([problem.simulator.segments[s].trial for s in problem.fit], lengths)
    trials = np.unique(owner)
    if len(trials) < 3:
        return np.zeros(scores.shape[1])
    pulls = np.array([scores[owner == t].sum(axis=0) for t in trials])
    meat = len(trials) / (len(trials) - 1.0) * pulls.T @ pulls
    variance = np.diag(inverse @ meat @ inverse).clip(0.0)
    half: FloatArray = stats.t.ppf(_LEVEL, len(trials) - 1) * np.sqrt(variance)
    return half


def _inverse(curvature: FloatArray) -> FloatArray:
    """Inverse under a unit diagonal, so that parameters of any size count alike."""
    size = np.sqrt(np.diag(curvature))
    # A parameter without any influence is open, not infinite.
    size = np.maximum(size, 1e-9 * (float(size.max()) or 1.0))
    values, vectors = np.linalg.eigh(curvature / np.outer(size, size))
    values = np.maximum(values, 1e-10)
    inverse: FloatArray = (vectors / values) @ vectors.T / np.outer(size, size)
    return inverse


def _long_run(scores: FloatArray, lengths: list[int], reach: int) -> FloatArray:
    """Long-run covariance of the scores' sum, Bartlett kernel, segments apart."""
    total = np.zeros((scores.shape[1], scores.shape[1]))
    at = 0
    for n in lengths:
        part = scores[at : at + n]
        at += n
        size = 1 << (2 * n - 1).bit_length()
        spectrum = np.fft.rfft(part, size, axis=0)
        last = min(reach, n - 1)
        kernel = np.zeros(size)
        kernel[: last + 1] = 1.0 - np.arange(last + 1) / (last + 1)
        if last:
            kernel[-last:] = kernel[1 : last + 1][::-1]
        # sum_tu k(t - u) g_t g_u' by convolution.
        smooth = np.fft.irfft(spectrum * np.fft.rfft(kernel)[:, None], size, axis=0)[:n]
        total += part.T @ smooth
    return 0.5 * (total + total.T)


def _discretization_pull(problem: Problem, jacobian: FloatArray, weight: FloatArray) -> FloatArray:
    """Gradient (parameters,) of what the correction of the simulator's step may leave."""
    parts = []
    for s in problem.fit:
        segment, add = problem.simulator.segments[s], problem.defect.get(int(s))
        width = jacobian.shape[1]
        if add is None:
            parts.append(np.zeros((len(segment.time), width)))
            continue
        columns = [add.position]
        if problem.effort_floor is not None and segment.effort is not None:
            columns.append(problem.trusted(int(s), add.effort))
        parts.append(np.concatenate(columns, axis=1))
    left = problem.weighed(np.nan_to_num(np.concatenate(parts)), problem.fit)
    change = problem.step_left * left
    pull: FloatArray = np.einsum("tsp,ts->p", jacobian, change * weight)
    return pull
