"""A hypothesis fitted where slopes lead nowhere.

Where a joint sticks and slips, a whole motion parts from another wherever a slide ends: what a
simulation leaves has leaps and valleys everywhere, and a fit by slopes stops in the first. An
evolution strategy asks for values alone (covariance matrix adaptation; Hansen, The CMA Evolution
Strategy: A Tutorial, 2016). Of the valleys that several searches end in the deepest may be a narrow
one by chance: the one stands whose neighbourhood leaves least.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.problem import Problem

# Hypotheses of one generation, which are one batch, those asked in all for each parameter, and
# searches from each start.
_GENERATION, _ASKED, _SEARCHES = 20, 200, 2
# First steps, as a share of what a parameter is, or of the least size that its law is asked at; the
# share of them below which a search has come to its end; and how far, and how many, neighbours are.
_STEP, _ENOUGH = 0.3, 1e-3
_NEAR, _NEIGHBOURS = 0.03, 24
# The cost of a simulation that diverged, in deviations.
_DIVERGED = 1e6


def sought(problem: Problem, starts: Sequence[Hypothesis], weights: FloatArray) -> Hypothesis:
    """A hypothesis at its least mean absolute deviation from the recordings that are fitted; of
    several such the one whose neighbours leave least.

    Absolute, not squared: of two slides that end apart one leaves as much as all that is followed
    well. The same starts come to the same end: draws have seeds of their own.

    Args:
        problem: what to explain.
        starts: of the same terms.
        weights: (signals,) reciprocal deviations.
    """
    if not starts[0].free:
        return starts[0]
    ends = [_end(problem, start, weights, k) for start in starts for k in range(_SEARCHES)]
    costs = [_around(problem, end, weights) for end in ends]
    return ends[int(np.argmin(costs))]


def _end(problem: Problem, start: Hypothesis, weights: FloatArray, seed: int) -> Hypothesis:
    """Where one search from a start ends."""
    # It brings half a second of imports, which few diagnoses need.
    import cma

    free = start.movable
    step = _STEP * start.sizes[free]
    lower, upper = (bound[free] / step for bound in start.bounds)
    random = np.random.default_rng(seed)
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
        asked = [_at(start, p * step) for p in points]
        costs = deviations(problem, asked, weights)
        strategy.tell(points, costs)
        first = int(np.argmin(costs))
        if costs[first] < least:
            best, least = asked[first], costs[first]
    return best


def _at(start: Hypothesis, values: FloatArray) -> Hypothesis:
    """What a start is with other values of what a fit moves, as far as its bounds go."""
    theta = start.theta.copy()
    theta[start.movable] = values
    return start.with_theta(np.clip(theta, *start.bounds))


def _around(problem: Problem, end: Hypothesis, weights: FloatArray) -> float:
    """Mean of what neighbours leave."""
    free = end.movable
    draws = np.random.default_rng(0).standard_normal((_NEIGHBOURS // 2, int(free.sum())))
    reach = _NEAR * end.sizes[free]
    near = [_at(end, end.theta[free] + reach * z) for z in (*draws, *-draws)]
    return float(np.mean(deviations(problem, near, weights)))


def deviations(problem: Problem, hypotheses: list[Hypothesis], weights: FloatArray) -> list[float]:
    """Weighted mean absolute deviation of each on the recordings that are fitted."""
    costs = [np.mean(np.abs(r) * weights) for r in problem.residuals(hypotheses, problem.fit)]
    return [float(c) if np.isfinite(c) else _DIVERGED for c in costs]
