"""Fit of stick-slip motion by an evolution strategy, which needs no gradient.

The cost of a whole stick-slip motion is discontinuous in the parameters, because a small change
moves the end of a slide. It has many local minima, and a gradient fit stops in the first. The
covariance matrix adaptation evolution strategy uses values of the cost only (CMA-ES; Hansen, The
CMA Evolution Strategy: A Tutorial, 2016). Its first covariance comes from a gradient fit to short
windows: parameters that these windows hardly separate are changed together. The best of several
searches is the result.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import Hypothesis
from pytest_twin.estimation.least_squares import FittedModel

# Number of searches, and evaluations of each for each parameter: all searches make the first half
# of them, and the best search alone makes the second half.
_SEARCHES, _EVALUATIONS = 4, 100
# First step: the change of the prediction by all parameters together, as a share of the residual in
# the windows; its upper limit, as a share of the parameter's value or of its smallest start. The
# search ends at steps below ``_LAST_STEP`` times the first one.
_FIRST_CHANGE, _STEP, _LAST_STEP = 0.5, 0.15, 1e-3
# Cost of a simulation that diverged, in standard deviations.
_DIVERGED = 1e6


def initial_covariance_root(fitted: FittedModel, floor: FloatArray) -> FloatArray:
    """Root ``A`` of the covariance ``A A'`` of the first steps, (parameters, parameters).

    Only the parameters that a fit estimates have rows and columns.

    Args:
        fitted: a fit to windows, with its Jacobian.
        floor: (signals,) noise floors in the windows.
    """
    free = fitted.hypothesis.is_estimated
    slopes = (fitted.jacobian[:, :, free] / floor[:, None]).reshape(-1, int(free.sum()))
    # A simulation that diverges next to the fit says nothing about the length of a step.
    slopes = np.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
    left = float(np.mean((fitted.residual / floor) ** 2))
    most = _STEP * fitted.hypothesis.sizes[free]
    changed = slopes.T @ slopes / len(slopes) / left
    precision = changed * len(most) / _FIRST_CHANGE**2 + np.diag(1.0 / most**2)
    root: FloatArray = np.linalg.inv(np.linalg.cholesky(precision)).T
    return root


def fit_by_evolution(
    problem: Problem, starts: Sequence[Hypothesis], weights: FloatArray, steps: FloatArray
) -> Hypothesis:
    """The hypothesis with the smallest mean absolute deviation from the fit recordings.

    Squared deviations would be dominated by the few slides that end at another place. The result is
    reproducible: each search has its own fixed seed.

    Args:
        starts: hypotheses with the same terms; the searches are divided among them.
        weights: (signals,) reciprocal standard deviations.
        steps: (parameters, parameters) result of :func:`initial_covariance_root`.
    """
    if not starts[0].free_count:
        return starts[0]
    count = _SEARCHES // len(starts)
    searches = [_Search(problem, s, weights, steps, k) for s in starts for k in range(count)]
    for each in searches:
        each.evolve(_EVALUATIONS // 2)
    best = min(searches, key=lambda each: each.best_cost)
    best.evolve(_EVALUATIONS - _EVALUATIONS // 2)
    return best.best


class _Search:
    """One run of the evolution strategy.

    Attributes:
        best, best_cost: the hypothesis with the smallest cost so far, and that cost.
    """

    def __init__(
        self,
        problem: Problem,
        start: Hypothesis,
        weights: FloatArray,
        steps: FloatArray,
        seed: int,
    ) -> None:
        # The import takes half a second, and few diagnoses need it.
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
                "tolx": _LAST_STEP,
                "verbose": -9,
            },
        )
        self.best, self.best_cost = start, mean_absolute_deviations(problem, [start], weights)[0]

    def evolve(self, evaluations: int) -> None:
        """Make ``evaluations`` more for each parameter, fewer if the strategy has converged."""
        strategy = self._strategy
        last = strategy.countevals + evaluations * len(self._steps)
        while strategy.countevals < last and not strategy.stop():
            points = strategy.ask()
            found = [self._hypothesis_at(p) for p in points]
            costs = mean_absolute_deviations(self._problem, found, self._weights)
            strategy.tell(points, costs)
            first = int(np.argmin(costs))
            if costs[first] < self.best_cost:
                self.best, self.best_cost = found[first], costs[first]

    def _hypothesis_at(self, point: FloatArray) -> Hypothesis:
        """The start plus (parameters,) multiples of the first steps, within the bounds."""
        theta = self._start.theta.copy()
        theta[self._start.is_estimated] += self._steps @ point
        return self._start.with_theta(np.clip(theta, *self._start.bounds))


def mean_absolute_deviations(
    problem: Problem, hypotheses: list[Hypothesis], weights: FloatArray
) -> list[float]:
    """Weighted mean absolute deviation of each hypothesis on the fit recordings."""
    costs = [np.mean(np.abs(r) * weights) for r in problem.residuals(hypotheses, problem.fit)]
    return [float(c) if np.isfinite(c) else _DIVERGED for c in costs]
