"""Nonlinear least squares for several hypotheses at once; all simulations share one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.hypothesis import Hypothesis

# Levenberg-Marquardt damping factors, relative to the diagonal of the normal matrix.
_DAMPINGS = (1e-4, 1e-1)
# Largest difference between the decrease of the cost and the one that the Jacobian predicts, as a
# share of the latter, with which the Jacobian is kept (gain ratio: Nocedal, Wright 2006, sec. 4.1).
_PREDICTED_WITHIN = 0.25
# A fit stops when a step reduces the cost by less than this share.
_CONVERGED = 1e-4
# Finite-difference step of the coordinates.
_COORDINATE_STEP = 1e-6
# A parameter is not fitted if a change by its own size moves the prediction by less than this share
# of the residual: its slope is rounding error. Example: the roll of a base with level axes only.
_NEGLIGIBLE_CHANGE = 1e-4
# Shares of a parameter's reach that are tried in addition to the step along the slope.
_REACH_SHARES = (-1.0, -0.25, 0.25, 1.0)


class Residuals(Protocol):
    """What a fit needs of a problem."""

    def residuals(
        self, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
    ) -> list[FloatArray]:
        """(samples, signals) residual of each hypothesis on segments, as ``Problem`` has it."""


@dataclass(slots=True)
class FittedModel:
    """A hypothesis at its optimum.

    Attributes:
        hypothesis: with the fitted parameters.
        residual: (samples, signals) weighted residual on the fit segments.
        jacobian: (samples, signals, parameters) derivative of the prediction with respect to the
            scaled parameters; without parameters if it was not requested.
        cost: weighted mean square of the residual.
    """

    hypothesis: Hypothesis
    residual: FloatArray
    jacobian: FloatArray
    cost: float

    @property
    def mean_square(self) -> FloatArray:
        """(signals,) mean square of the residual."""
        mean_square: FloatArray = np.mean(self.residual**2, axis=0)
        return mean_square


def fit(
    problem: Residuals,
    starts: Sequence[Hypothesis],
    weights: FloatArray,
    segments: NDArray[np.int64],
    *,
    iterations: int,
    slopes: bool = True,
    jacobians: Sequence[FloatArray] | None = None,
) -> list[FittedModel]:
    """Levenberg-Marquardt on all ``starts`` at once (Nocedal, Wright 2006, sec. 10.3).

    Args:
        starts: hypotheses with starting values.
        weights: (signals,) reciprocal standard deviations.
        segments: indices of the segments that are fitted.
        iterations: largest number of steps; a fit that has converged stops earlier.
        slopes: whether the Jacobian at the optimum is needed.
        jacobians: an approximate Jacobian of each start. All steps then use it with Broyden's
            rank-one update (Math. Comp. 19, 1965), which needs no further simulation.

    Returns:
        The optimum of each start, in the same order.

    Raises:
        OutOfTime: the time of the search is over.
    """
    current = list(starts)
    residual = problem.residuals(current, segments)
    cost = [weighted_cost(r, weights) for r in residual]
    known: list[FloatArray | None] = [None] * len(current) if jacobians is None else [*jacobians]
    # Whether a Jacobian belongs to the present parameters, and whether a step has confirmed it.
    is_exact, is_trusted = ([False] * len(current) for _ in range(2))
    active = [i for i, h in enumerate(current) if h.theta.size]
    for _ in range(iterations):
        missing = [i for i in active if known[i] is None]
        if missing:
            _fill_jacobians(problem, current, residual, segments, missing, known)
            for i in missing:
                is_exact[i] = is_trusted[i] = True
        steps = {i: _possible_steps(current[i], residual[i], known[i], weights) for i in active}
        # Where a trusted Jacobian predicts no decrease, no step is simulated.
        active = [
            i for i in active
            if not is_trusted[i] or any(
                predicted is None or predicted < cost[i] * (1.0 - _CONVERGED)
                for _, predicted in steps[i]
            )
        ]  # fmt: skip
        if not active:
            break
        ends = np.cumsum([0, *(len(steps[i]) for i in active)])
        tried = problem.residuals([h for i in active for h, _ in steps[i]], segments)
        unconverged = []
        for k, i in enumerate(active):
            costs = [weighted_cost(r, weights) for r in tried[ends[k] : ends[k + 1]]]
            best = int(np.argmin(costs))
            (new, predicted), change = steps[i][best], residual[i] - tried[ends[k] + best]
            decrease = cost[i] - costs[best]
            is_predicted = predicted is not None and _is_near(decrease, cost[i] - predicted)
            if decrease > _CONVERGED * cost[i] or not (is_exact[i] or is_predicted):
                unconverged.append(i)
            if jacobians is not None or is_predicted:
                known[i] = broyden_update(known[i], new.theta - current[i].theta, change)
                is_trusted[i] = True
            elif decrease > 0.0 or not is_exact[i]:
                known[i] = None
            if decrease > 0.0:
                current[i], residual[i], cost[i] = new, residual[i] - change, costs[best]
                is_exact[i] = False
        active = unconverged
    if slopes:
        missing = [i for i, h in enumerate(current) if known[i] is None and h.theta.size]
        if missing:
            _fill_jacobians(problem, current, residual, segments, missing, known)
    out = []
    for i, h in enumerate(current):
        jac = known[i]
        shape = (*residual[i].shape, 0)
        out.append(
            FittedModel(
                h, residual[i], np.empty(shape) if jac is None or not slopes else jac, cost[i]
            )
        )
    return out


def _possible_steps(
    h: Hypothesis, residual: FloatArray, jacobian: FloatArray | None, weights: FloatArray
) -> list[tuple[Hypothesis, float | None]]:
    """Steps of a fit, with the cost that the Jacobian predicts; None for distant steps."""
    assert jacobian is not None
    damped = [propose_step(h, residual, jacobian, weights, d) for d in _DAMPINGS]
    steps: list[tuple[Hypothesis, float | None]] = [
        (new, weighted_cost(residual - jacobian @ (new.theta - h.theta), weights)) for new in damped
    ]
    return [*steps, *((new, None) for new in distant_steps(h))]


def _is_near(decrease: float, predicted: float) -> bool:
    return abs(decrease - predicted) <= _PREDICTED_WITHIN * predicted


def broyden_update(jacobian: FloatArray | None, step: FloatArray, change: FloatArray) -> FloatArray:
    """Broyden's rank-one update: the Jacobian then reproduces ``change`` for ``step``."""
    assert jacobian is not None
    length = float(step @ step)
    if length == 0.0 or not np.isfinite(change).all():
        return jacobian
    corrected: FloatArray = jacobian + (change - jacobian @ step)[..., None] * (step / length)
    return corrected


def weighted_cost(residual: FloatArray, weights: FloatArray) -> float:
    """Weighted mean square; infinite where a simulation diverged."""
    value = float(np.mean((residual * weights) ** 2))
    return value if np.isfinite(value) else np.inf


def _fill_jacobians(
    problem: Residuals,
    current: Sequence[Hypothesis],
    residual: Sequence[FloatArray],
    segments: NDArray[np.int64],
    which: Sequence[int],
    into: list[FloatArray | None],
) -> None:
    """Jacobians of the hypotheses ``which`` by finite differences, written to ``into``."""
    moved: list[Hypothesis] = []
    steps: list[float] = []
    for i in which:
        rows, by = finite_differences(current[i])
        moved += rows
        steps += by
    found = problem.residuals(moved, segments)
    at = 0
    for i in which:
        slopes = np.zeros((*residual[i].shape, current[i].theta.size))
        for k in np.flatnonzero(current[i].is_estimated):
            slopes[..., k] = (residual[i] - found[at]) / steps[at]
            at += 1
        into[i] = np.nan_to_num(slopes)


def finite_differences(h: Hypothesis) -> tuple[list[Hypothesis], list[float]]:
    """One hypothesis for each estimated parameter, perturbed by its finite-difference step.

    Perturbed parameters stay within their bounds.

    Returns:
        The perturbed hypotheses, and the steps in multiples of the scales.
    """
    _, upper = h.bounds
    parameters = [p for t in h.terms for p in t.parameters]
    rows, steps = [], []
    for k in np.flatnonzero(h.is_estimated):
        p = parameters[k]
        step = p.step * max(1.0, abs(h.theta[k]))
        step = -step if h.theta[k] + step > upper[k] else step
        theta = h.theta.copy()
        theta[k] += step
        rows.append(h.with_theta(theta))
        steps.append(step)
    return rows, steps


def propose_steps(
    h: Hypothesis,
    residual: FloatArray,
    jacobian: FloatArray,
    weights: FloatArray,
    dampings: Sequence[float],
) -> list[Hypothesis]:
    """Candidates of one fit step: a damped step for each damping, and the distant steps.

    Args:
        residual: (samples, signals).
        jacobian: (samples, signals, parameters).
        weights: (signals,) reciprocal standard deviations.
        dampings: relative to the diagonal of the normal matrix.
    """
    equations = _step_equations(h, residual, jacobian, weights)
    return [_damped_step(h, *equations, d) for d in dampings] + distant_steps(h)


def distant_steps(h: Hypothesis) -> list[Hypothesis]:
    """The hypothesis with one parameter at a time changed by shares of its reach.

    The slope of such a parameter is valid only near its value.
    """
    parameters = [p for t in h.terms for p in t.parameters]
    rows = []
    for k, p in enumerate(parameters):
        if p.reach is None:
            continue
        for part in _REACH_SHARES:
            theta = h.theta.copy()
            theta[k] = np.clip(theta[k] + part * p.reach, p.lower, p.upper)
            rows.append(h.with_theta(theta))
    return rows


def propose_step(
    h: Hypothesis, residual: FloatArray, jacobian: FloatArray, weights: FloatArray, damping: float
) -> Hypothesis:
    """A damped Gauss-Newton step within the bounds, in the coordinates of each law.

    A parameter at a bound stays there if its step points outwards. The hypothesis is unchanged if
    the normal matrix overflows. Arguments are as in :func:`propose_steps`.
    """
    return _damped_step(h, *_step_equations(h, residual, jacobian, weights), damping)


def _step_equations(
    h: Hypothesis, residual: FloatArray, jacobian: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Normal matrix and gradient in the coordinates of the laws, and whether parameters are free.

    No parameter is free if the normal matrix overflows.
    """
    slopes = (jacobian * weights[:, None]).reshape(-1, h.theta.size)
    b = np.nan_to_num(residual * weights).ravel()
    products, change = slopes.T @ slopes, _coordinate_jacobian(h)
    normal, gradient = change.T @ products @ change, change.T @ (slopes.T @ b)
    moves = np.sqrt(np.diag(products) / len(b)) * h.sizes
    # The Jacobian of a discrete choice is rounding error too.
    free = h.is_estimated & (moves > _NEGLIGIBLE_CHANGE * np.sqrt(np.mean(b**2)))
    return normal, gradient, free & bool(np.isfinite(normal).all())


def _damped_step(
    h: Hypothesis,
    normal: FloatArray,
    gradient: FloatArray,
    free: NDArray[np.bool_],
    damping: float,
) -> Hypothesis:
    """The step of :func:`propose_step` from its equations."""
    if not free.any():
        return h
    (lower, upper), free = h.bounds, free.copy()
    theta = h.theta.copy()
    for _ in range(h.theta.size):
        n = normal[np.ix_(free, free)]
        ridge = damping * np.diag(np.maximum(np.diag(n), 1e-12 * max(n.max(initial=0.0), 1e-30)))
        step = np.zeros_like(theta)
        step[free] = np.linalg.lstsq(n + ridge, gradient[free], rcond=None)[0]
        proposal = h.from_coordinates(h.coordinates + step)
        outside = free & ((proposal < lower) | (proposal > upper))
        if not outside.any():
            return h.with_theta(proposal)
        theta = np.clip(proposal, lower, upper)
        blocked = outside & ((h.theta <= lower) & (step < 0) | (h.theta >= upper) & (step > 0))
        if not blocked.any():
            return h.with_theta(theta)
        free &= ~blocked
        if not free.any():
            break
    return h.with_theta(np.clip(theta, lower, upper))


def _coordinate_jacobian(h: Hypothesis) -> FloatArray:
    """(parameters, parameters) Jacobian of the parameters with respect to their coordinates."""
    out, at = np.zeros((h.theta.size, h.theta.size)), 0
    for term in h.terms:
        own = h.theta[at : at + len(term.parameters)]
        here, place = term.law.coordinates(own), slice(at, at + len(own))
        moved = [term.law.from_coordinates(here + _COORDINATE_STEP * e) for e in np.eye(len(own))]
        out[place, place] = (np.array(moved).T - own[:, None]) / _COORDINATE_STEP
        at += len(own)
    return out
