"""Uncertainty of contact parameters, and the combinations that tosses do not determine.

A quadratic function of the parameters is fitted to the mean error at points around the minimum, so
that small discontinuities of the engine average out (response surface; Box, Wilson, 1951). Whole
tosses are then resampled with replacement. Each resample has its own quadratic and minimum (cluster
bootstrap; Efron, Tibshirani, 1993). All samples of a toss share its initial state and its surface,
so single samples are never resampled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.covariance import small_sample_factor
from pytest_twin.identification.contact.search import Loss

REACH = 0.1
"""Half width of the region of the quadratic, on the parameters' scales. Below 0.05 discontinuities
of the error exceed its curvature; above 0.2 the error is not quadratic."""
_NARROW = (0.5 * REACH, 0.25 * REACH)
"""Smaller regions for errors that are not quadratic over the larger one."""
_SHARP = 1.02
"""Ratio of the errors at the minimum of the quadratic surface and at its centre up to which the
surface is accepted."""
_ENDLESS = 0.1
"""Fraction of resamples without a minimum above which a direction is undetermined."""
DRAWS = 400
"""Number of resamples. It gives a standard deviation with 5 % precision."""
UNDETERMINED = 0.15
"""Standard deviation on the scale above which a parameter is undetermined. A uniform distribution
over the bounds has 0.29."""
_SPARE = 4
"""Number of points per coefficient of the quadratic."""


@dataclass(frozen=True)
class Surface:
    """Quadratic approximation of the error of each toss.

    Attributes:
        centre: (p,) position from which steps count.
        coefficients: (c, t) of each toss: constant, p linear, p (p + 1) / 2 quadratic.
        reach: half width of the region, on the scales.
    """

    centre: FloatArray
    coefficients: FloatArray
    reach: float = REACH

    def parts(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient (p,) and Hessian (p, p) of the weighted mean error at the centre."""
        count = len(self.centre)
        mean = self.coefficients @ (weights / weights.sum())
        hessian = np.zeros((count, count))
        hessian[np.triu_indices(count)] = mean[1 + count :]
        return mean[1 : 1 + count], hessian + hessian.T

    def step(self, weights: FloatArray) -> FloatArray:
        """(p,) step to the minimum; along directions without one, to the end of the region."""
        gradient, hessian = self.parts(weights)
        values, vectors = np.linalg.eigh(hessian)
        along = vectors.T @ gradient
        most = 2.0 * self.reach
        with np.errstate(divide="ignore", invalid="ignore"):
            inner = np.where(values > 0.0, -along / values, -np.sign(along) * most)
        return np.asarray(vectors @ np.clip(inner, -most, most))


def surface(loss: Loss, centre: FloatArray, groups: Sequence[int]) -> Surface:
    """Fit the quadratics over a region in which their minimum does not increase the error.

    Args:
        centre: (p,) position on the scales.
        groups: (s,) index of the toss of each segment.
    """
    found = _surface(loss, centre, groups, REACH)
    for reach in _NARROW:
        everything = np.ones(found.coefficients.shape[1])
        there = np.clip(centre + found.step(everything), 0.0, 1.0)
        here, moved = by_toss(loss([centre, there]), groups).mean(axis=1)
        if moved <= _SHARP * here:
            break
        found = _surface(loss, centre, groups, reach)
    return found


def _surface(loss: Loss, centre: FloatArray, groups: Sequence[int], reach: float) -> Surface:
    count = len(centre)
    terms = 1 + count + count * (count + 1) // 2
    power = int(np.ceil(np.log2(_SPARE * terms)))
    drawn = qmc.Sobol(count, seed=2).random_base2(power)
    places = np.clip(centre + reach * (2.0 * drawn - 1.0), 0.0, 1.0)
    found = loss(list(places))
    matrix = _features(places - centre)
    coefficients = np.linalg.lstsq(matrix, by_toss(found, groups), rcond=None)[0]
    return Surface(centre, np.asarray(coefficients, dtype=np.float64), reach)


def _features(steps: FloatArray) -> FloatArray:
    rows, columns = np.triu_indices(steps.shape[1])
    squares = steps[:, rows] * steps[:, columns]
    return np.hstack([np.ones((len(steps), 1)), steps, squares])


@dataclass(frozen=True)
class BootstrapMinimum:
    """Minimum, covariance and undetermined combinations.

    Attributes:
        centre: (p,) minimum, on the scales.
        covariance: (p, p) covariance of the minimum.
        undetermined: (p,) unit vectors of undetermined combinations.
    """

    centre: FloatArray
    covariance: FloatArray
    undetermined: tuple[FloatArray, ...]


def bootstrap_minimum(
    found: Surface,
    free: Sequence[int],
    rivals: Sequence[Sequence[FloatArray]] = (),
) -> BootstrapMinimum:
    """Compute minimum and covariance by a bootstrap over whole tosses.

    Args:
        found: quadratic of all parameters.
        free: indices of the estimated parameters; the others stay at the centre.
        rivals: groups of other positions (p,) that predict the tosses equally well. The mean
            square distance of each group is added to the covariance.
    """
    kept = np.array(free, dtype=int)
    part = Surface(found.centre[kept], _selected_coefficients(found, kept), found.reach)
    tosses = found.coefficients.shape[1]
    rng = np.random.default_rng(3)
    weights = rng.multinomial(tosses, np.full(tosses, 1.0 / tosses), size=DRAWS)
    steps = np.array([part.step(row.astype(float)) for row in weights])
    centre = np.clip(part.centre + part.step(np.ones(tosses)), 0.0, 1.0)
    covariance = small_sample_factor(tosses) ** 2 * np.atleast_2d(np.cov(steps, rowvar=False))
    for group in rivals:
        if group:
            apart = np.array(group)[:, kept] - centre
            covariance = covariance + apart.T @ apart / len(group)
    values, vectors = np.linalg.eigh(covariance)
    # A step to the end of the region means that there is no minimum.
    endless = np.mean(np.abs(steps @ vectors) > 1.9 * found.reach, axis=0) > _ENDLESS
    undetermined = [
        vectors[:, at] for at in range(len(values)) if values[at] > UNDETERMINED**2 or endless[at]
    ]
    return BootstrapMinimum(centre, covariance, tuple(undetermined))


def is_as_good(one: FloatArray, other: FloatArray) -> bool:
    """Whether the second of two predictions of the same tosses is not significantly worse.

    Args:
        one, other: (t,) mean errors of each toss.
    """
    worse = other - one
    return bool(np.mean(worse) < 2.0 * np.std(worse, ddof=1) / np.sqrt(len(worse)))


def by_toss(found: FloatArray, groups: Sequence[int]) -> FloatArray:
    """(e, t) means of (e, s) errors over the segments of each toss."""
    members = np.array([[one == toss for one in groups] for toss in sorted(set(groups))], float)
    return np.asarray(found @ (members / members.sum(axis=1, keepdims=True)).T)


def _selected_coefficients(found: Surface, kept: FloatArray) -> FloatArray:
    count = len(found.centre)
    rows, columns = np.triu_indices(count)
    squares = np.isin(rows, kept) & np.isin(columns, kept)
    keep = np.concatenate([[True], np.isin(np.arange(count), kept), squares])
    return np.asarray(found.coefficients[keep])
