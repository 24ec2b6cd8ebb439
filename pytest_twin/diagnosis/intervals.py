"""Confidence intervals of parameters that are valid for correlated residuals and model error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, stdtrit

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.interval_settings import INTERVALS
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.base import SMOOTH_STEP
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel
from pytest_twin.estimation.score import effective_samples
from pytest_twin.formats.record_fields import Z95
from pytest_twin.metrics.joint_covariance import upper_covariance, with_deviations

NearbyModel = tuple[float, Mapping[Term, FloatArray]]
"""A structure that explains nearly as much: its odds, and for each shared term the difference of
its parameters to those of the best structure, in multiples of their scales."""

# Quantile of a two-sided 95 % interval.
_LEVEL = 0.975
_LEAST_INFLUENCE = 1e-9
"""Size of a derivative, relative to the largest, up to which a parameter has no influence."""


@dataclass(frozen=True, slots=True)
class ParameterUncertainty:
    """Uncertainty of the parameters of a fit.

    Attributes:
        half_width: (parameters,) half width of the 95 % interval, in multiples of the scales.
        correlation: (parameters, parameters) correlation matrix.
        covariance: (parameters, parameters) covariance matrix of the scaled parameters.
        quantile: quantile of Student's t distribution that the half widths contain.
        conservative_covariance: (parameters, parameters) covariance matrix with half widths of
            1.96 deviations, which is in no direction narrower than the estimates that these are
            the widest of.
    """

    half_width: FloatArray
    correlation: FloatArray
    covariance: FloatArray
    quantile: float
    conservative_covariance: FloatArray

    def normalized_distance(self, which: NDArray[np.int64], offset: FloatArray) -> float:
        """Normalized distance of a point from the fit: 1 on the border of the joint 95 % region.

        It uses the correlations of the parameters (Wald test).

        Args:
            which: (n,) indices of parameters.
            offset: (n,) differences from the fit, in multiples of the scales.
        """
        scaled = offset / np.maximum(self.half_width[which], 1e-300)
        values, vectors = np.linalg.eigh(self.correlation[np.ix_(which, which)])
        square = np.sum((vectors.T @ scaled) ** 2 / np.maximum(values, INTERVALS.least_variance))
        one, together = (float(chdtri(n, 2.0 - 2.0 * _LEVEL)) for n in (1, len(which)))
        return float(np.sqrt(square * one / together))


def parameter_uncertainty(
    problem: Problem,
    fitted: FittedModel,
    nearby: Sequence[NearbyModel] = (),
    *,
    in_parts: bool = True,
) -> ParameterUncertainty:
    """Intervals from the curvature at the optimum, from recordings and from other structures.

    Residuals are correlated in time, and every model is inexact. The widest of three estimates is
    used: the sandwich covariance of the scores with a Bartlett kernel (Newey, West, Econometrica
    55, 1987), the white-noise covariance scaled to the effective samples (Geyer 1992), and the
    jackknife over recordings (:func:`jackknife`).

    The variance of a parameter between structures that explain nearly as much is added (Buckland,
    Burnham, Augustin, Biometrics 53, 1997). The remaining discretization error is a bias and is
    added linearly. If the simulation is discontinuous in a parameter, its interval is at least as
    wide as its finite-difference step.

    Args:
        fitted: the fit, with its Jacobian.
        nearby: structures that explain nearly as much.
        in_parts: whether fewer than three recordings are cut into parts for the jackknife. It is
            not valid for a fit that has not converged, which differs between parts.
    """
    count = fitted.hypothesis.theta.size
    if not count:
        none = np.zeros((0, 0))
        return ParameterUncertainty(np.zeros(0), none, none, 0.0, none)
    residual, floor = fitted.residual, problem.signal_floor
    mean_square = np.maximum(np.mean(residual**2, axis=0), floor**2)
    weight = 1.0 / mean_square
    lengths = problem.lengths(problem.fit)
    effective = np.maximum(effective_samples(residual, lengths), 2.0)
    jac = fitted.jacobian
    curvature = np.einsum("tsp,s,tsq->pq", jac, weight, jac)
    inverse = _scaled_inverse(curvature)
    enlarged = np.einsum("tsp,s,tsq->pq", jac, weight * len(residual) / effective, jac)
    scores = np.einsum("tsp,ts->tp", jac, residual * weight)
    ranges = 2.0 * len(residual) / effective
    meat = _long_run_covariance(scores, lengths, int(np.ceil(ranges.max())))
    enlarged_covariance = inverse @ enlarged @ inverse
    sandwich = inverse @ meat @ inverse
    variance = np.maximum(np.diag(enlarged_covariance), np.diag(sandwich)).clip(0.0)
    # Both are zero for a parameter without influence (a limit that is not reached): no residual
    # depends on it. The inverse has its large finite variance.
    unseen = _without_influence(curvature)
    variance[unseen] = np.diag(inverse)[unseen]
    deviation = np.sqrt(variance)
    base = np.sqrt(np.diag(enlarged_covariance).clip(1e-300))
    correlation = enlarged_covariance / np.outer(base, base)
    freedom = max(float(effective.max()) - count, 2.0)
    quantile = float(stdtrit(freedom, _LEVEL))
    shift = np.abs(inverse @ _discretization_gradient(problem, jac, weight))
    owner = clusters([problem.simulator.segments[s].trial for s in problem.fit], lengths)
    information = _cluster_information(jac, weight, owner)
    left_out = jackknife(_score_sums(scores, owner), information)
    if (
        not in_parts
        and len({problem.simulator.segments[s].trial for s in problem.fit})
        < INTERVALS.fewest_clusters
    ):
        left_out = np.zeros_like(left_out)
    half = np.maximum(quantile * deviation, np.sqrt(np.diag(left_out)))
    together = upper_covariance(
        quantile**2 * upper_covariance(enlarged_covariance, sandwich), left_out
    )
    half = np.hypot(half, quantile * _between_structures(fitted.hypothesis, nearby))
    for i, p in enumerate(p for t in fitted.hypothesis.terms for p in t.parameters):
        if p.step > SMOOTH_STEP:
            shift[i] = max(shift[i], p.step)
    not_estimated = ~fitted.hypothesis.is_estimated
    half[not_estimated] = shift[not_estimated] = 0.0
    return ParameterUncertainty(
        half + shift,
        correlation,
        correlation * np.outer(deviation, deviation),
        quantile,
        with_deviations(together, half + shift) / Z95**2,
    )


def jackknife(scores: FloatArray, information: FloatArray) -> FloatArray:
    """(parameters, parameters) covariance by the jackknife over clusters, times a squared quantile.

    The roots of its diagonal are half widths of 95 % intervals. For each cluster a Gauss-Newton
    step from the optimum without it is computed. This is the estimator CR3 of MacKinnon and White
    (J. Econometrics 29, 1985) and Bell and McCaffrey (Survey Methodology 28, 2002). The quantile is
    Student's with (clusters - 1) degrees of freedom. It is valid if the model error differs between
    recordings, which residuals within one do not show.

    Args:
        scores: (clusters, parameters) gradients at the optimum.
        information: (clusters, parameters, parameters) curvatures.
    """
    count, size = scores.shape
    if count < INTERVALS.fewest_clusters:
        return np.zeros((size, size))
    whole = information.sum(axis=0)
    scale = np.sqrt(np.diag(whole))
    # A parameter without influence gets a large finite variance.
    scale = np.maximum(scale, _LEAST_INFLUENCE * (float(scale.max()) or 1.0))
    values, vectors = np.linalg.eigh(whole / np.outer(scale, scale))
    root = (vectors / np.sqrt(np.maximum(values, 1e-10))) / scale[:, None]
    moved = np.empty((count, size))
    for k in range(count):
        shares, axes = np.linalg.eigh(root.T @ information[k] @ root)
        # A parameter that only one cluster determines cannot be fitted without it.
        without = 1.0 / (1.0 - np.minimum(shares, INTERVALS.most_leverage))
        moved[k] = root @ (axes * without) @ axes.T @ root.T @ -scores[k]
    deviation = moved - moved.mean(axis=0)
    covariance = (count - 1.0) / count * deviation.T @ deviation
    return np.asarray(stdtrit(count - 1, _LEVEL) ** 2 * covariance)


def clusters(trials: Sequence[int], lengths: Sequence[int]) -> NDArray[np.int64]:
    """(samples,) index of the cluster of each sample.

    A cluster is a recording. Fewer than three recordings are each cut into equal parts in time.

    Args:
        trials: index of the recording of each segment.
        lengths: number of samples of each segment.
    """
    owner = np.repeat(np.asarray(trials, dtype=np.int64), lengths)
    known, numbers = np.unique(owner, return_inverse=True)
    if len(known) >= INTERVALS.fewest_clusters:
        return np.asarray(numbers, dtype=np.int64)
    parts = -(-INTERVALS.parts // max(len(known), 1))
    out = np.empty(len(owner), dtype=np.int64)
    for k in range(len(known)):
        own = np.flatnonzero(numbers == k)
        out[own] = k * parts + np.arange(len(own)) * parts // max(len(own), 1)
    return out


def _score_sums(scores: FloatArray, owner: NDArray[np.int64]) -> FloatArray:
    """(clusters, parameters) sums of (samples, parameters) scores."""
    return np.array([scores[owner == k].sum(axis=0) for k in range(int(owner.max()) + 1)])


def _cluster_information(
    jacobian: FloatArray, weight: FloatArray, owner: NDArray[np.int64]
) -> FloatArray:
    """(clusters, parameters, parameters) curvature of each cluster."""
    parts = [jacobian[owner == k] for k in range(int(owner.max()) + 1)]
    return np.array([np.einsum("tsp,s,tsq->pq", part, weight, part) for part in parts])


def _between_structures(hypothesis: Hypothesis, nearby: Sequence[NearbyModel]) -> FloatArray:
    """(parameters,) standard deviation between structures, weighted by their posterior shares."""
    whole = 1.0 + sum(odds for odds, _ in nearby)
    variance = np.zeros(hypothesis.theta.size)
    for odds, moved in nearby:
        for term, offset in moved.items():
            if term in hypothesis.terms:
                variance[hypothesis.slice_of(term)] += odds / whole * offset**2
    deviation: FloatArray = np.sqrt(variance)
    return deviation


def _without_influence(curvature: FloatArray) -> NDArray[np.bool_]:
    """(parameters,) whether the residual depends on none of a parameter's changes."""
    influence: FloatArray = np.diag(curvature)
    return np.asarray(influence <= _LEAST_INFLUENCE**2 * float(influence.max()))


def _scaled_inverse(curvature: FloatArray) -> FloatArray:
    """Inverse, computed with a unit diagonal for good conditioning."""
    size = np.sqrt(np.diag(curvature))
    # A parameter without influence gets a large finite variance.
    size = np.maximum(size, _LEAST_INFLUENCE * (float(size.max()) or 1.0))
    values, vectors = np.linalg.eigh(curvature / np.outer(size, size))
    values = np.maximum(values, 1e-10)
    inverse: FloatArray = (vectors / values) @ vectors.T / np.outer(size, size)
    return inverse


def _long_run_covariance(scores: FloatArray, lengths: list[int], reach: int) -> FloatArray:
    """Long-run covariance of the sum of scores with a Bartlett kernel; segments are independent."""
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


def _discretization_gradient(
    problem: Problem, jacobian: FloatArray, weight: FloatArray
) -> FloatArray:
    """(parameters,) gradient of the cost by the discretization error that may remain."""
    parts = []
    for s in problem.fit:
        segment, add = problem.simulator.segments[s], problem.discretization_error.get(int(s))
        width = jacobian.shape[1]
        if add is None:
            parts.append(np.zeros((len(segment.time), width)))
            continue
        columns = [add.position]
        if problem.effort_floor is not None and segment.effort is not None:
            columns.append(problem.weigh_efforts(int(s), add.effort))
        parts.append(np.concatenate(columns, axis=1))
    step_error = problem.weigh_positions(np.nan_to_num(np.concatenate(parts)), problem.fit)
    change = problem.step_left * step_error
    pull: FloatArray = np.einsum("tsp,ts->p", jacobian, change * weight)
    return pull
