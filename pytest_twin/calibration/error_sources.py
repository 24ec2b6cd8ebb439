"""Variance components of pose errors: camera across and along its view, and robot.

An error of the flange's orientation moves a distant target more than a near one, and a camera
measures depth less accurately than the other directions. One weight for all positions and one for
all angles would ignore both. The variance of each source is estimated from the residuals, together
with the unknowns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import State, Variables
from pytest_twin.calibration.records import CalibrationEstimate
from pytest_twin.calibration.solve import Fit, at_state, prior_rows, prior_values
from pytest_twin.calibration.terms import PoseTerm, by_flange
from pytest_twin.estimation.covariance import block_jackknife

SOURCES = ("across", "along", "rotation", "flange_translation", "flange_rotation")
"""Sources: errors of the target's position across and along the view (m), of its orientation (rad),
and of the flange's position (m) and orientation (rad)."""

FEWEST_DEGREES = 40.0
"""Fewest degrees of freedom from which five variances are estimated. Each variance is then known to
a factor of two, which costs less accuracy than a common weight of two sources."""

_ROUNDS = 60
"""Largest number of iterations."""
_SETTLED, _SMALL_STEP = 3e-3, 1e-6
"""Changes below which the estimate has converged: of a source's standard deviation, relative to
that of the residuals, and of the unknowns, m and rad."""
_LEAST = 1e-4
"""Smallest standard deviation of a source, relative to that of the residuals. A source with
variance zero could not grow again in the iteration."""


@dataclass(frozen=True)
class _Linear:
    """Inliers at a state: (n, 6) residuals, (n, 6, count) Jacobian, (5, n, 6, 6) parts."""

    residuals: FloatArray
    slopes: FloatArray
    parts: FloatArray

    def weights(self, variances: FloatArray) -> FloatArray:
        """(n, 6, 6) inverse covariance of each measurement."""
        return np.asarray(np.linalg.inv(np.tensordot(variances, self.parts, 1)))


def weigh_by_source(found: CalibrationEstimate) -> tuple[CalibrationEstimate, Mapping[str, float]]:
    """Return the estimate weighted by the variance of each error source, and the sources' sizes.

    Restricted maximum likelihood by the minorize-maximize algorithm (Zhou, Hu, Zhou, Lange: MM
    algorithms for variance components models, 2019). The estimate is returned unchanged, without
    sizes, in three cases: other measurements than target poses exist, there are too few poses, or
    the arm has errors that are not estimated.
    """
    fit = found.fit
    terms = fit.problem.terms
    if len(terms) != 1 or not isinstance(terms[0], PoseTerm) or found.lost.any():
        return found, {}
    layout = fit.problem.layout
    if fit.degrees < FEWEST_DEGREES or layout.count == 0:
        return found, {}
    if fit.problem.chain is not None and not layout.zeros and not layout.links:
        # Errors of an arm whose zeros are not estimated repeat with the pose, so they are no noise.
        return found, {}
    kept = fit.kept[0]
    state = fit.state
    usual = np.array([fit.noise["translation"], fit.noise["rotation"]])
    scale = usual[[0, 0, 1, 0, 1]] ** 2
    variances = scale / 2.0
    priors = prior_rows(fit.problem)
    prior = priors.T @ priors
    linear = _linearize(fit, state, kept)
    for _ in range(_ROUNDS):
        state, step = _gauss_newton_step(fit, state, linear, variances, priors)
        linear = _linearize(fit, state, kept)
        new = np.maximum(_variances(linear, variances, prior), _LEAST**2 * scale)
        change = float(np.abs(np.sqrt(new / scale) - np.sqrt(variances / scale)).max())
        variances = new
        if change < _SETTLED and step < _SMALL_STEP:
            break
    weights = linear.weights(variances)
    normal = _product(linear.slopes, weights @ linear.slopes) + prior
    try:
        covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    except np.linalg.LinAlgError:
        return found, {}
    quantile = float(student.ppf(0.975, max(fit.degrees, 1.0)))
    if fit.problem.is_odometry:
        root = np.swapaxes(np.linalg.cholesky(weights), 1, 2)
        residuals = np.einsum("nab,nb->na", root, linear.residuals)
        covariance, quantile = block_jackknife(root @ linear.slopes, residuals, prior)
    better = replace(found, fit=at_state(fit, state), covariance=covariance, quantile=quantile)
    return better, dict(zip(SOURCES, np.sqrt(variances).tolist(), strict=True))


def _linearize(fit: Fit, state: State, kept: np.ndarray) -> _Linear:
    problem = fit.problem
    term = problem.terms[0]
    assert isinstance(term, PoseTerm)
    variables = Variables(problem.layout, state, np.zeros(problem.layout.count))
    flange = problem.flange(variables)
    residuals, slopes = term.residuals(flange, variables)
    robot = by_flange(term, flange, variables)[kept]
    parts = np.zeros((len(SOURCES), int(kept.sum()), 6, 6))
    parts[0, :, [0, 1], [0, 1]] = 1.0
    parts[1, :, 2, 2] = 1.0
    parts[2, :, [3, 4, 5], [3, 4, 5]] = 1.0
    parts[3] = robot[:, :, :3] @ np.swapaxes(robot[:, :, :3], 1, 2)
    parts[4] = robot[:, :, 3:] @ np.swapaxes(robot[:, :, 3:], 1, 2)
    return _Linear(residuals[kept], slopes[kept], parts)


def _gauss_newton_step(
    fit: Fit, state: State, linear: _Linear, variances: FloatArray, priors: FloatArray
) -> tuple[State, float]:
    """Return the state after a Gauss-Newton step, and the step's largest component, m or rad."""
    slopes = linear.weights(variances) @ linear.slopes
    normal = _product(linear.slopes, slopes) + priors.T @ priors
    right = np.einsum("nap,na->p", slopes, linear.residuals)
    right += priors.T @ prior_values(fit.problem, state)
    step = -np.linalg.lstsq(normal, right, rcond=1e-14)[0]
    return fit.problem.layout.moved(state, step), float(np.abs(step).max())


def _variances(linear: _Linear, variances: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the next variances: each is scaled by the root of explained over expected squares."""
    weights = linear.weights(variances)
    slopes = weights @ linear.slopes
    covariance = np.linalg.pinv(_product(linear.slopes, slopes) + prior)
    pull = np.einsum("nab,nb->na", weights, linear.residuals)
    explained = np.sum((linear.parts @ pull[..., None])[..., 0] * pull, axis=(1, 2))
    expected = np.einsum("nab,knba->k", weights, linear.parts)
    taken = slopes @ covariance @ np.swapaxes(slopes, 1, 2)
    expected -= np.einsum("nab,knba->k", taken, linear.parts)
    return np.asarray(variances * np.sqrt(explained / np.maximum(expected, 1e-12)))


def _product(first: FloatArray, second: FloatArray) -> FloatArray:
    """(count, count) sum over measurements and residuals of two (n, 6, count) tables."""
    count = first.shape[2]
    return np.asarray(first.reshape(-1, count).T @ second.reshape(-1, count))
