"""A hypothesis fitted where slopes lead nowhere.

Where a joint sticks and slips, a whole motion parts from another wherever a slide ends: what a
simulation leaves has leaps and valleys everywhere, and a fit by slopes stops in the first. An
evolution strategy asks for values alone (covariance matrix adaptation; Hansen, The CMA Evolution
Strategy: A Tutorial, 2016). It begins with what short windows say of the parameters, where slopes
do lead somewhere: they are moved together as those windows hardly separate them, which is how
valleys of whole motions lie. The deepest of several searches stands.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.fit import Fitted
from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.problem import Problem

# Searches in all, and hypotheses that each may ask, for each parameter: all of them half as many,
# the deepest the other half.
_SEARCHES, _ASKED = 4, 100
# First steps: by how much of what windows leave all parameters together change what they predict,
# and at most, as a share of what a parameter is or of the least size that its law is asked at; and
# the share of a first step below which a search has come to its end.
_CHANGED, _STEP, _ENOUGH = 0.5, 0.15, 1e-3
# The cost of a simulation that diverged, in deviations.
_DIVERGED = 1e6


def initial_covariance_root(fitted: Fitted, floor: FloatArray) -> FloatArray:
    """(parameters, parameters) a root of the covariance of a search's first steps, by rows; of
    what a fit moves.

    Args:
        fitted: in windows, with slopes.
        floor: (signals,) deviations of a sample there.
    """
    free = fitted.hypothesis.movable
    slopes = (fitted.jacobian[:, :, free] / floor[:, None]).reshape(-1, int(free.sum()))
    # A divergence beside the fit is no measure of how far to go.
    slopes = np.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
    left = float(np.mean((fitted.residual / floor) ** 2))
    most = _STEP * fitted.hypothesis.sizes[free]
    changed = slopes.T @ slopes / len(slopes) / left
    precision = changed * len(most) / _CHANGED**2 + np.diag(1.0 / most**2)
    root: FloatArray = np.linalg.inv(np.linalg.cholesky(precision)).T
    return root


def fit_by_evolution(
    problem: Problem, starts: Sequence[Hypothesis], weights: FloatArray, steps: FloatArray
) -> Hypothesis:
    """A hypothesis at its least mean absolute deviation from the recordings that are fitted.

    Absolute, not squared: of two slides that end apart one leaves as much as all that is followed
    well. The same starts come to the same end: draws have seeds of their own.

    Args:
        problem: what to explain.
        starts: of the same terms; searches are shared out among them.
        weights: (signals,) reciprocal deviations.
        steps: (parameters, parameters) as :func:`initial_covariance_root` has them.
    """
    if not starts[0].free:
        return starts[0]
    count = _SEARCHES // len(starts)
    searches = [_Search(problem, s, weights, steps, k) for s in starts for k in range(count)]
    for each in searches:
        each.go_on(_ASKED // 2)
    deepest = min(searches, key=lambda each: each.least)
    deepest.go_on(_ASKED - _ASKED // 2)
    return deepest.best


class _Search:
    """One evolution.

    Attributes:
        best, least: the hypothesis that leaves least, and how much that is.
    """

    def __init__(
        self,
        problem: Problem,
        start: Hypothesis,
        weights: FloatArray,
        steps: FloatArray,
        seed: int,
    ) -> None:
        # It brings half a second of imports, which few diagnoses need.
        import cma

        self._problem, self._start, self._weights, self._steps = problem, start, weights, steps
        random = np.random.default_rng(seed)
        size = len(steps)
        self._strategy = cma.CMAEvolutionStrategy(
            np.zeros(size),
            1.0,
            {
                "popsize": 2 * int(np.ceil(4.0 + 3.0 * np.log(size))),
                "seed": np.nan,
                "randn": lambda *shape: random.standard_normal(shape),
                "tolx": _ENOUGH,
                "verbose": -9,
            },
        )
        self.best, self.least = start, mean_absolute_deviations(problem, [start], weights)[0]

    def go_on(self, asked: int) -> None:
        """Ask for so many more hypotheses for each parameter, until none brings anything."""
        strategy = self._strategy
        last = strategy.countevals + asked * len(self._steps)
        while strategy.countevals < last and not strategy.stop():
            points = strategy.ask()
            found = [self._at(p) for p in points]
            costs = mean_absolute_deviations(self._problem, found, self._weights)
            strategy.tell(points, costs)
            first = int(np.argmin(costs))
            if costs[first] < self.least:
                self.best, self.least = found[first], costs[first]

    def _at(self, point: FloatArray) -> Hypothesis:
        """So many first steps from the start, as far as its bounds go."""
        theta = self._start.theta.copy()
        theta[self._start.movable] += self._steps @ point
        return self._start.with_theta(np.clip(theta, *self._start.bounds))


def mean_absolute_deviations(
    problem: Problem, hypotheses: list[Hypothesis], weights: FloatArray
) -> list[float]:
    """Weighted mean absolute deviation of each on the recordings that are fitted."""
    costs = [np.mean(np.abs(r) * weights) for r in problem.residuals(hypotheses, problem.fit)]
    return [float(c) if np.isfinite(c) else _DIVERGED for c in costs]
