"""The search over a problem that a test made, with fixed settings of its simulation."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.search.linearized_view import View
from pytest_twin.diagnosis.search.physics import Physics, SimulatedPhysics
from pytest_twin.diagnosis.search.posterior import best_named
from pytest_twin.diagnosis.search.search import Search, SearchOutcome
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis


class ProblemPhysics(SimulatedPhysics):
    """The physics of a problem that no recordings stand behind."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.candidates = tuple(candidates(problem))
        self.recorded = RecordedRange.of(problem)

    @property
    def noise(self) -> FloatArray:
        return self.floor

    def other_friction_constraint(self, hypothesis: Hypothesis) -> Iterator[Physics]:
        return iter(())

    def other_settings(self, hypothesis: Hypothesis, *, is_explained: bool) -> Iterator[Physics]:
        """No setting of the simulation is open."""
        return iter(())


def searched(
    problem: Problem, start: Hypothesis = EMPTY, rounds: int | None = None
) -> SearchOutcome:
    """The outcome of a search that starts with a hypothesis."""
    search = Search(ProblemPhysics(problem))
    return search.run([search.simulated(start)] if start.terms else [], rounds)


def named(problem: Problem, start: Hypothesis = EMPTY) -> Hypothesis:
    """The set of effects that is reported."""
    return best_named(searched(problem, start), lambda _: 0, lambda _: True)


def nominal_view(problem: Problem) -> View:
    """The motion linearized around the nominal model."""
    (residual,) = problem.residuals([EMPTY], problem.fit)
    return ProblemPhysics(problem).linearize(EMPTY, residual, np.zeros((*residual.shape, 0)))
