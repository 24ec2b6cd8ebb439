"""A hypothesis fitted where slopes lead nowhere.

Where a joint sticks and slips, a whole motion parts from another wherever a slide ends: what a
simulation leaves has leaps and valleys everywhere, and a fit by slopes stops in the first. An
evolution strategy asks for values alone (covariance matrix adaptation; Hansen, The CMA Evolution
Strategy: A Tutorial, 2016).
"""

from __future__ import annotations

import numpy as np

from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.base import FloatArray

# Hypotheses of one generation, which are one batch, and those asked in all for each parameter.
_GENERATION, _ASKED = 20, 200
# First steps, as a share of what a parameter is, or of the least size that its law is asked at.
_STEP = 0.3
# Share of the first steps below which it has come to its end.
_ENOUGH = 1e-3
# The cost of a simulation that diverged, in deviations.
_DIVERGED = 1e6


def sought(problem: Problem, start: Hypothesis, weights: FloatArray) -> Hypothesis:
    """The hypothesis at its least mean absolute deviation from the recordings that are fitted.

    Absolute, not squared: of two slides that end apart one leaves as much as all that is followed
    well. The same start comes to the same end: draws have a seed of their own.

    Args:
        problem: what to explain.
        start: with starting values.
        weights: (signals,) reciprocal deviations.
    """
    free = start.movable
    if not free.any():
        return start
    # It brings half a second of imports, which few diagnoses need.
    import cma

    step = _STEP * start.sizes[free]
    lower, upper = (bound[free] / step for bound in start.bounds)

    def at(point: FloatArray) -> Hypothesis:
        theta = start.theta.copy()
        theta[free] = point * step
        return start.with_theta(np.clip(theta, *start.bounds))

    random = np.random.default_rng(1)
    strategy = cma.CMAEvolutionStrategy(
        np.clip(start.theta[free] / step, lower, upper),
        1.0,
        {
            "bounds": [list(lower), list(upper)],
            "popsize": _GENERATION,
            "maxfevals": _ASKED * start.free,
            "seed": np.nan,
            "randn": lambda *shape: random.standard_normal(shape),
            "tolx": _ENOUGH,
            "verbose": -9,
        },
    )
    best, least = start, deviations(problem, [start], weights)[0]
    while not strategy.stop():
        points = strategy.ask()
        asked = [at(p) for p in points]
        costs = deviations(problem, asked, weights)
        strategy.tell(points, costs)
        first = int(np.argmin(costs))
        if costs[first] < least:
            best, least = asked[first], costs[first]
    return best


def deviations(problem: Problem, hypotheses: list[Hypothesis], weights: FloatArray) -> list[float]:
    """Weighted mean absolute deviation of each on the recordings that are fitted."""
    costs = [np.mean(np.abs(r) * weights) for r in problem.residuals(hypotheses, problem.fit)]
    return [float(c) if np.isfinite(c) else _DIVERGED for c in costs]
