"""Errors of many hypotheses without a fit, on the fit segments with the largest residual."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import weighted_cost


class CostScreen:
    """Simulates hypotheses on half of the fit segments, to choose which of them are fitted.

    Attributes:
        weights: (signals,) reciprocal standard deviations.
        segments: indices of the segments, those with the largest weighted residual.
    """

    def __init__(self, best: ScoredModel, left: FloatArray) -> None:
        """Choose segments by the residual of ``best``, with weights from mean squares ``left``."""
        self.problem = problem = best.problem
        self.weights = problem.weights(left)
        ends = np.cumsum(problem.lengths(problem.fit))[:-1]
        parts = np.split(best.fitted.residual, ends)
        missing = [np.nansum((part * self.weights) ** 2) for part in parts]
        most = np.argsort(missing)[::-1][: (len(parts) + 1) // 2]
        self.segments = problem.fit[np.sort(most)]

    def costs(self, rows: Sequence[Hypothesis]) -> list[float]:
        """Weighted mean squared error of each hypothesis; infinite where it diverges."""
        found = self.problem.residuals(rows, self.segments)
        return [weighted_cost(r, self.weights) for r in found]

    def best_of_each_term(self, rows: Sequence[Hypothesis]) -> list[Hypothesis]:
        """For each last term the hypothesis with the smallest error, best first."""
        costs = self.costs(rows)
        found: dict[Term, Hypothesis] = {}
        for i in np.argsort(costs):
            if np.isfinite(costs[i]):
                found.setdefault(rows[i].terms[-1], rows[i])
        return list(found.values())
