"""Robust weighted least squares: noise is estimated, outliers are excluded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2, halfnorm

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import State
from pytest_twin.calibration.problem import CalibrationProblem
from pytest_twin.time_limit import is_over

STUDENT_DEGREES = 4.0
"""Degrees of freedom of the Student distribution for the weights of the robust iterations. With 4,
an outlier has little weight and inliers lose few per cent of theirs (Lange, Little, Taylor,
1989)."""

OUTLIER_PROBABILITY = 0.01
"""Probability that any good observation is excluded (Bonferroni)."""

LEAST_INLIERS = 0.35
"""Fraction of the measurements that are assumed good. Outliers may be the majority as long as they
do not agree with each other."""

OUTLIER_RATIO = 3.5
"""A measurement is excluded only if its error exceeds that of the best third by this factor. Errors
of a real robot have heavier tails than the normal distribution. Its bound alone would exclude one
pose in six of a good data set and bias the fit towards the model."""

LEAST_OUTLIER = {"translation": 1e-4, "rotation": 1e-3, "point": 1e-4, "pixel": 0.1}
"""Smallest residual of an outlier, m, rad, m and px. Lens and corners of images have errors of this
size that are no mistakes."""

LEAST_ROWS = 8
"""Fewest observations for excluding outliers. Two or three poses always agree with each other."""

MOST_UNKNOWN = 2 / 3
"""Largest number of unknowns per residual for excluding outliers."""

FEW_DEGREES = 10.0
"""Degrees of freedom below which the noise of positions and angles is estimated together. Separate
estimates could converge to zero for one of them."""

_LEVER_M = {"translation": 0.5, "rotation": 1.0}
"""Ratio of position noise to angle noise, m/rad, where both are estimated together. It fits a
camera at half a metre from the target."""

NOISE_FLOOR = {"translation": 1e-9, "rotation": 1e-9, "point": 1e-9, "pixel": 1e-6}
"""Smallest standard deviation of residuals, m, rad, m and px, which exact synthetic data need."""

_ROBUST_ITERATIONS = 20
"""Number of iterations of the robust fit."""
_ROBUST_STEPS = 4
"""Largest number of evaluations in each iteration of the robust fit."""
_FINAL_STEPS = 60
"""Largest number of evaluations in the last fit."""
_EXCLUDING_ITERATIONS = 12
"""Largest number of iterations that exclude outliers and fit again."""
_NORMAL_QUANTILE = float(halfnorm.ppf(LEAST_INLIERS))


@dataclass(frozen=True)
class Fit:
    """Solution of a least-squares problem.

    Attributes:
        noise: kind of noise -> standard deviation, m, rad or px.
        kept: for each term, (m,) True for inliers, which were fitted.
        residuals: for each term, (m, columns) residuals of all measurements.
        jacobian: (rows, count) derivatives of inlier residuals and priors, divided by their
            standard deviations.
        degrees: smallest degrees of freedom among the kinds of noise.
    """

    problem: CalibrationProblem
    state: State
    noise: Mapping[str, float]
    kept: tuple[np.ndarray, ...]
    residuals: tuple[FloatArray, ...]
    jacobian: FloatArray
    degrees: float


def robust_cost(problem: CalibrationProblem, state: State) -> float:
    """Return the size of the residuals of the best third at a state, to compare starts.

    Residuals are divided by fixed sizes (1 mm, 1 mrad, 1 px), so that states can be compared before
    the noise is known.
    """
    total = 0.0
    found = problem.residuals(state, np.zeros(problem.layout.count))
    for term, (residual, _) in zip(problem.terms, found, strict=True):
        sizes = np.array([1.0 if name == "pixel" else 1e-3 for name in term.noise])
        total += float(np.quantile(np.linalg.norm(residual / sizes, axis=1), LEAST_INLIERS))
    return total


def solve(problem: CalibrationProblem, start: State) -> Fit:
    """Return the weighted least-squares solution from a start, with outliers excluded."""
    everything = tuple(np.ones(len(term.rows), dtype=bool) for term in problem.terms)
    state = start
    residuals, _ = _residuals(problem, state)
    noise = _spread(problem, residuals, everything)
    # The robust iterations use every measurement; outliers have little weight.
    robust = _is_redundant(problem)
    for _ in range(_ROBUST_ITERATIONS if robust else 0):
        if is_over():
            break
        weights = [
            np.sqrt((STUDENT_DEGREES + len(term.noise)) / (STUDENT_DEGREES + distance))
            for term, distance in zip(
                problem.terms, _distances(problem, residuals, noise), strict=True
            )
        ]
        state = _least_squares(problem, state, noise, weights, _ROBUST_STEPS)
        residuals, _ = _residuals(problem, state)
        before, noise = noise, _spread(problem, residuals, everything)
        if all(abs(noise[name] / before[name] - 1.0) < 0.02 for name in noise):
            break
    kept = everything
    for _ in range(_EXCLUDING_ITERATIONS):
        chosen = everything
        if robust:
            chosen = _inliers(problem, residuals, _distances(problem, residuals, noise))
        same = all(np.array_equal(a, b) for a, b in zip(chosen, kept, strict=True))
        kept = chosen
        state = _least_squares(problem, state, noise, [one.astype(float) for one in kept])
        residuals, slopes = _residuals(problem, state)
        before, noise = noise, _noise(problem, residuals, slopes, noise, kept)
        if same and all(abs(noise[name] / before[name] - 1.0) < 1e-3 for name in noise):
            break
        if is_over():
            break
    jacobian = _whiten(problem, slopes, noise, [one.astype(float) for one in kept])
    degrees = _degrees(problem, jacobian, kept)
    return Fit(problem, state, noise, kept, tuple(residuals), jacobian, degrees)


def _is_redundant(problem: CalibrationProblem) -> bool:
    """Whether there are enough observations to detect outliers."""
    rows = {int(row) for term in problem.terms for row in term.rows}
    total = sum(len(term.rows) * len(term.noise) for term in problem.terms)
    return len(rows) >= LEAST_ROWS and problem.layout.count <= MOST_UNKNOWN * total


def whitened_jacobian(
    problem: CalibrationProblem,
    state: State,
    noise: Mapping[str, float],
    kept: tuple[np.ndarray, ...] | None = None,
) -> FloatArray:
    """(rows, count) derivatives of residuals and priors, divided by their standard deviations.

    Args:
        kept: for each term, (m,) True where a measurement is used; by default all are.
    """
    slopes = _residuals(problem, state)[1]
    counted = kept or tuple(np.ones(len(term.rows), dtype=bool) for term in problem.terms)
    return _whiten(problem, slopes, noise, [one.astype(float) for one in counted])


def _residuals(
    problem: CalibrationProblem, state: State
) -> tuple[list[FloatArray], list[FloatArray]]:
    found = problem.residuals(state, np.zeros(problem.layout.count))
    return [one for one, _ in found], [slope for _, slope in found]


def _sizes(problem: CalibrationProblem, noise: Mapping[str, float]) -> list[FloatArray]:
    return [np.array([noise[name] for name in term.noise]) for term in problem.terms]


def _distances(
    problem: CalibrationProblem,
    residuals: list[FloatArray] | tuple[FloatArray, ...],
    noise: Mapping[str, float],
) -> list[FloatArray]:
    sizes = _sizes(problem, noise)
    return [np.sum((one / size) ** 2, axis=1) for one, size in zip(residuals, sizes, strict=True)]


def _names(problem: CalibrationProblem) -> list[str]:
    return list(dict.fromkeys(name for term in problem.terms for name in term.noise))


def _columns(
    problem: CalibrationProblem, values: list[FloatArray], name: str, kept: object
) -> FloatArray:
    """Return all residuals of one kind of noise."""
    parts = []
    for at, term in enumerate(problem.terms):
        columns = [i for i, one in enumerate(term.noise) if one == name]
        if columns:
            parts.append(values[at][kept[at]][:, columns].reshape(-1))  # type: ignore[index]
    return np.concatenate(parts) if parts else np.zeros(0)


def _spread(
    problem: CalibrationProblem, residuals: list[FloatArray], kept: tuple[np.ndarray, ...]
) -> dict[str, float]:
    """Estimate the noise robustly, from the smallest residuals."""
    found = {}
    total = sum(residual.size for residual in residuals)
    share = max(1.0 - problem.layout.count / max(total, 1), 0.1)
    for name in _names(problem):
        values = np.abs(_columns(problem, residuals, name, kept))
        size = float(np.quantile(values, LEAST_INLIERS)) if len(values) else 0.0
        spread = size / _NORMAL_QUANTILE / np.sqrt(share)
        found[name] = max(spread, NOISE_FLOOR[name])
    return found


def _noise(
    problem: CalibrationProblem,
    residuals: list[FloatArray],
    slopes: list[FloatArray],
    noise: Mapping[str, float],
    kept: tuple[np.ndarray, ...],
) -> dict[str, float]:
    """Estimate the noise of each kind: squared residuals over degrees of freedom."""
    jacobian = _whiten(problem, slopes, noise, [one.astype(float) for one in kept])
    left = np.linalg.svd(jacobian, full_matrices=False)
    rank = left[1] > 1e-10 * max(left[1].max(initial=0.0), 1e-300)
    leverage = np.sum(left[0][:, rank] ** 2, axis=1)
    used: dict[str, float] = dict.fromkeys(_names(problem), 0.0)
    at = 0
    for term in problem.terms:
        block = leverage[at : at + len(term.rows) * len(term.noise)].reshape(len(term.rows), -1)
        at += block.size
        for column, name in enumerate(term.noise):
            used[name] += float(block[:, column].sum())
    squares, free = {}, {}
    for name in used:
        values = _columns(problem, residuals, name, kept)
        squares[name], free[name] = float(np.sum(values**2)), len(values) - used[name]
    found = {}
    pooled = "rotation" in used and min(free.values()) < FEW_DEGREES
    for name in used:
        if pooled and name in _LEVER_M:
            both = sum(squares[one] / _LEVER_M[one] ** 2 for one in _LEVER_M if one in used)
            count = sum(free[one] for one in _LEVER_M if one in used)
            spread = _LEVER_M[name] * float(np.sqrt(both / count)) if count > 0.5 else noise[name]
        elif free[name] > 0.5:
            spread = float(np.sqrt(squares[name] / free[name]))
        else:
            spread = noise[name]
        found[name] = max(spread, NOISE_FLOOR[name])
    return found


def _inliers(
    problem: CalibrationProblem, residuals: list[FloatArray], distances: list[FloatArray]
) -> tuple[np.ndarray, ...]:
    total = sum(len(one) for one in distances)
    found = []
    for term, residual, distance in zip(problem.terms, residuals, distances, strict=True):
        bound = chi2.isf(OUTLIER_PROBABILITY / total, len(term.noise))
        typical = float(np.quantile(distance, LEAST_INLIERS))
        small = np.abs(residual) < [LEAST_OUTLIER[name] for name in term.noise]
        found.append((distance <= max(bound, OUTLIER_RATIO**2 * typical)) | small.all(axis=1))
    return tuple(found)


def _whiten(
    problem: CalibrationProblem,
    slopes: list[FloatArray],
    noise: Mapping[str, float],
    weights: list[FloatArray],
) -> FloatArray:
    rows = [
        (slope * weight[:, None, None] / size[:, None]).reshape(-1, problem.layout.count)
        for slope, weight, size in zip(slopes, weights, _sizes(problem, noise), strict=True)
    ]
    return np.concatenate([*rows, prior_rows(problem)])


def at_state(fit: Fit, state: State) -> Fit:
    """Return the fit with residuals, noise and derivatives at another state."""
    residuals, slopes = _residuals(fit.problem, state)
    noise = _noise(fit.problem, residuals, slopes, fit.noise, fit.kept)
    jacobian = _whiten(fit.problem, slopes, noise, [one.astype(float) for one in fit.kept])
    return replace(fit, state=state, noise=noise, residuals=tuple(residuals), jacobian=jacobian)


def prior_rows(problem: CalibrationProblem) -> FloatArray:
    """(priors, count) derivatives of the priors' residuals, in standard deviations."""
    parameters = problem.layout.parameters
    rows = [np.eye(len(parameters))[i] / p.prior for i, p in enumerate(parameters) if p.prior]
    return np.reshape(rows, (-1, len(parameters)))


def prior_values(problem: CalibrationProblem, state: State) -> FloatArray:
    """(priors,) residuals of the priors, in standard deviations."""
    layout = problem.layout
    values = np.zeros(layout.count)
    if layout.zeros:
        values[layout.blocks["joint_zeros"]] = state.zeros[list(layout.zeros)]
    if layout.links:
        values[layout.blocks["geometry"]] = state.links
    if layout.scale:
        values[layout.blocks["scale"]] = state.scale - 1.0
    return prior_rows(problem) @ values


def _least_squares(
    problem: CalibrationProblem,
    state: State,
    noise: Mapping[str, float],
    weights: list[FloatArray],
    steps: int = _FINAL_STEPS,
) -> State:
    if problem.layout.count == 0:
        return state
    priors = prior_rows(problem)
    sizes = _sizes(problem, noise)

    known: dict[bytes, list[tuple[FloatArray, FloatArray]]] = {}

    def evaluated(step: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        # Residuals and derivatives are computed together and both needed at each step.
        key = step.tobytes()
        if key not in known:
            known.clear()
            known[key] = problem.residuals(state, step)
        return known[key]

    def residuals(step: FloatArray) -> FloatArray:
        rows = [
            (residual * weight[:, None] / size).reshape(-1)
            for (residual, _), weight, size in zip(evaluated(step), weights, sizes, strict=True)
        ]
        return np.concatenate([*rows, prior_values(problem, state) + priors @ step])

    def jacobian(step: FloatArray) -> FloatArray:
        return _whiten(problem, [slope for _, slope in evaluated(step)], noise, weights)

    start = np.zeros(problem.layout.count)
    # MINPACK's method is the fastest here, but does not accept fewer residuals than unknowns.
    rows = sum(len(t.rows) * len(t.noise) for t in problem.terms) + len(priors)
    method: Literal["lm", "trf"] = "lm" if rows >= len(start) else "trf"
    found = least_squares(residuals, start, jacobian, method=method, x_scale="jac", max_nfev=steps)
    return problem.layout.moved(state, np.asarray(found.x))


def _degrees(
    problem: CalibrationProblem, jacobian: FloatArray, kept: tuple[np.ndarray, ...]
) -> float:
    """Return the smallest degrees of freedom among the kinds of noise."""
    left, singular, _ = np.linalg.svd(jacobian, full_matrices=False)
    rank = singular > 1e-10 * max(singular.max(initial=0.0), 1e-300)
    leverage = np.sum(left[:, rank] ** 2, axis=1)
    free = dict.fromkeys(_names(problem), 0.0)
    at = 0
    for term, chosen in zip(problem.terms, kept, strict=True):
        block = leverage[at : at + len(term.rows) * len(term.noise)].reshape(len(term.rows), -1)
        at += block.size
        for column, name in enumerate(term.noise):
            free[name] += float(np.sum(1.0 - block[chosen, column]))
    if "rotation" in free and min(free.values()) < FEW_DEGREES:
        return sum(free.values())
    return min(free.values(), default=0.0)
