"""A structure search in the place of the present one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pytest_twin.diagnosis.hypothesis import EMPTY
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.contest import Contest
from pytest_twin.diagnosis.search.rivals import Place, Rival, Selected
from pytest_twin.diagnosis.structure_search.refit import as_fitted
from pytest_twin.diagnosis.structure_search.search import Result, StructureSearch


class Selection:
    """One search over structures.

    Args:
        problem: what to explain.
        run: the diagnosis that the search belongs to.
        share_left: as the present search takes it; not used.
        leave: asked of each accepted model; whether the search ends there.
    """

    def __init__(
        self,
        problem: Problem,
        run: Run | None = None,
        share_left: float = 1.0,
        leave: Callable[[Rival], bool] = lambda rival: False,
    ) -> None:
        self.problem, self.leave, self.share_left = problem, leave, share_left
        self.diagnosis_run = Run() if run is None else run
        self.contest = Contest(problem, self.diagnosis_run)
        self.left_off = False

    def anew(self) -> Selection:
        """Another search of the same problem, which may have changed."""
        return Selection(self.problem, self.diagnosis_run, self.share_left)

    def run(self, start: Rival | None = None) -> Selected:
        """The chosen model and its alternatives."""
        search = StructureSearch(
            self.problem,
            self.diagnosis_run,
            leave=lambda m: self.leave(
                Rival(as_fitted(self.problem, m, np.zeros((*m.residual.shape, 0))), m.validation)
            ),
        )
        result = search.run(EMPTY if start is None else start.hypothesis)
        fitted = as_fitted(self.problem, result.model, result.jacobian)
        best = Rival(fitted, result.model.validation)
        selected = Selected(best, self.contest.nominal, tried=self.contest.tried)
        selected.weigh(evidence(result))
        self.left_off = result.has_left
        return selected


def evidence(result: Result) -> dict[Place, float]:
    """Log-likelihood ratio of each alternative in the place of accepted terms."""
    own = set(result.model.hypothesis.terms)
    found: dict[Place, float] = {}
    for model, gain in result.rivals:
        terms = set(model.hypothesis.terms)
        gone, new = own - terms, terms - own
        if not gone or len(new) > 1:
            continue
        for term in gone:
            place = (term,), next(iter(new), None)
            value = min(gain, 0.0) if np.isfinite(gain) else -np.inf
            found[place] = max(found.get(place, -np.inf), value)
    return found
