"""Fit rival hypotheses together: every perturbation of every rival is a row of one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.problem import Problem

_DAMPINGS = (1e-4, 1e-1)
_FAST, _ENOUGH = 0.5, 1e-4
_TINY = 1e-6
# A parameter that moves the prediction by less than this share of the whole residual has a slope of
# rounding errors only: a roll of the base where all axes are level.
_MUTE = 1e-4
# Parts of its reach by which a parameter is tried beside its slope.
_REACHED = (-1.0, -0.25, 0.25, 1.0)


@dataclass(slots=True)
class Fitted:
    """A hypothesis at its optimum.

    Attributes:
        hypothesis: with the fitted parameters.
        residual: (samples, signals) on the fit segments.
        jacobian: (samples, signals, parameters) of the prediction, per scaled parameter; empty
            where it was not wanted.
        cost: weighted mean square on the fit segments.
    """

    hypothesis: Hypothesis
    residual: FloatArray
    jacobian: FloatArray
    cost: float

    @property
    def mean_square(self) -> FloatArray:
        """(signals,) of the residual."""
        mean_square: FloatArray = np.mean(self.residual**2, axis=0)
        return mean_square


def fit(
    problem: Problem,
    starts: Sequence[Hypothesis],
    weights: FloatArray,
    segments: NDArray[np.int64],
    *,
    iterations: int,
    slopes: bool = True,
    jacobians: Sequence[FloatArray] | None = None,
) -> list[Fitted]:
    """Levenberg-Marquardt on all ``starts`` at once (Nocedal, Wright 2006, sec. 10.3).

    Args:
        problem: what to explain.
        starts: rival hypotheses with starting values.
        weights: (signals,) reciprocal deviations.
        segments: fit on these.
        iterations: steps at most; a rival that no longer gains stops earlier.
        slopes: whether the Jacobian at the optimum is wanted.
        jacobians: of each start, where they are known well enough for a first step. Later steps
            take them too, corrected by what the steps show (Broyden, Math. Comp. 19, 1965), which
            costs no simulation.
    """
    current = list(starts)
    residual = problem.residuals(current, segments)
    cost = [weighted_cost(r, weights) for r in residual]
    known: list[FloatArray | None] = [None] * len(current) if jacobians is None else [*jacobians]
    fresh = [False] * len(current)
    active = [i for i, h in enumerate(current) if h.theta.size]
    for _ in range(iterations):
        if not active:
            break
        missing = [i for i in active if known[i] is None]
        if missing:
            _fill_jacobians(problem, current, residual, segments, missing, known)
            for i in missing:
                fresh[i] = True
        trials: list[Hypothesis] = []
        ends = [0]
        for i in active:
            jac = known[i]
            assert jac is not None
            trials += proposals(current[i], residual[i], jac, weights, _DAMPINGS)
            ends.append(len(trials))
        tried = problem.residuals(trials, segments)
        still = []
        for k, i in enumerate(active):
            options = range(ends[k], ends[k + 1])
            best = min(options, key=lambda o: weighted_cost(tried[o], weights))
            gained = weighted_cost(tried[best], weights)
            # The slopes of the last step serve on while they bring the cost down fast.
            fast = gained < _FAST * cost[i]
            if jacobians is not None:
                step = trials[best].theta - current[i].theta
                known[i] = _corrected(known[i], step, residual[i] - tried[best])
                fresh[i] = True
            if gained < cost[i]:
                if gained < cost[i] * (1.0 - _ENOUGH) or not fresh[i]:
                    still.append(i)
                current[i], residual[i], cost[i] = trials[best], tried[best], gained
            elif not fresh[i]:
                still.append(i)
            fresh[i] = False
            if not fast and jacobians is None:
                known[i] = None
        active = still
    if slopes:
        stale = [i for i, h in enumerate(current) if not fresh[i] and h.theta.size]
        if stale:
            _fill_jacobians(problem, current, residual, segments, stale, known)
    out = []
    for i, h in enumerate(current):
        jac = known[i]
        shape = (*residual[i].shape, 0)
        out.append(
            Fitted(h, residual[i], np.empty(shape) if jac is None or not slopes else jac, cost[i])
        )
    return out


def _corrected(jacobian: FloatArray | None, step: FloatArray, change: FloatArray) -> FloatArray:
    """A Jacobian that predicts the change of the prediction that a step has shown."""
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
    problem: Problem,
    current: Sequence[Hypothesis],
    residual: Sequence[FloatArray],
    segments: NDArray[np.int64],
    which: Sequence[int],
    into: list[FloatArray | None],
) -> None:
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
        for k in np.flatnonzero(current[i].movable):
            slopes[..., k] = (residual[i] - found[at]) / steps[at]
            at += 1
        into[i] = np.nan_to_num(slopes)


def finite_differences(h: Hypothesis) -> tuple[list[Hypothesis], list[float]]:
    """A hypothesis with each parameter that a fit moves moved by its finite difference, inside its
    bounds, and these differences.
    """
    _, upper = h.bounds
    parameters = [p for t in h.terms for p in t.parameters]
    rows, steps = [], []
    for k in np.flatnonzero(h.movable):
        p = parameters[k]
        step = p.step * max(1.0, abs(h.theta[k]))
        step = -step if h.theta[k] + step > upper[k] else step
        theta = h.theta.copy()
        theta[k] += step
        rows.append(h.with_theta(theta))
        steps.append(step)
    return rows, steps


def proposals(
    h: Hypothesis,
    residual: FloatArray,
    jacobian: FloatArray,
    weights: FloatArray,
    dampings: Sequence[float],
) -> list[Hypothesis]:
    """What one step of a fit tries: along the slope under each damping, and beside it."""
    along = [propose(h, residual, jacobian, weights, d) for d in dampings]
    return along + distant_steps(h)


def distant_steps(h: Hypothesis) -> list[Hypothesis]:
    """A hypothesis with one parameter at a time where its slope would not lead."""
    parameters = [p for t in h.terms for p in t.parameters]
    rows = []
    for k, p in enumerate(parameters):
        if p.reach is None:
            continue
        for part in _REACHED:
            theta = h.theta.copy()
            theta[k] = np.clip(theta[k] + part * p.reach, p.lower, p.upper)
            rows.append(h.with_theta(theta))
    return rows


def propose(
    h: Hypothesis, residual: FloatArray, jacobian: FloatArray, weights: FloatArray, damping: float
) -> Hypothesis:
    """A damped Gauss-Newton step inside the bounds; parameters at a bound that pull out stay.

    It is taken in the coordinates of each law. Where slopes overflow it goes nowhere.
    """
    lower, upper = h.bounds
    slopes = (jacobian * weights[:, None]).reshape(-1, h.theta.size)
    a = slopes @ _chart(h)
    b = np.nan_to_num(residual * weights).ravel()
    normal, gradient = a.T @ a, a.T @ b
    moves = np.sqrt(np.mean(slopes**2, axis=0)) * h.sizes
    # Of a choice rounding has a slope all the same.
    free = h.movable & (moves > _MUTE * np.sqrt(np.mean(b**2)))
    if not np.isfinite(normal).all() or not free.any():
        return h
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


def _chart(h: Hypothesis) -> FloatArray:
    """(parameters, parameters) change of the parameters per change of their coordinates."""
    here = h.coordinates
    moved = [h.from_coordinates(here + _TINY * e) for e in np.eye(h.theta.size)]
    return np.array(moved).T / _TINY - h.theta[:, None] / _TINY
