"""Rivals that come close: what the simulator's step costs each of them is its own."""

from __future__ import annotations

import numpy as np
import pytest
from test_behind_gears import fitted, with_true
from test_first_order import ELBOW, SHOULDER, problem_of

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.effects.segment import Predicted

DRAG, DRY = Term("viscous_friction", ELBOW), Term("coulomb_friction", ELBOW)
ELSEWHERE = Term("viscous_friction", SHOULDER)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {DRAG: {"coefficient": 0.2}})


@pytest.mark.parametrize(("floors", "fitted_on"), [(0.1, False), (1.0, True)])
def test_a_rival_is_fitted_on_where_its_own_step_moves_it(
    problem: Problem, monkeypatch: pytest.MonkeyPatch, floors: float, fitted_on: bool
) -> None:
    comparison = ModelComparison(problem)
    rough = fitted(comparison, with_true(problem, DRAG, {"coefficient": 0.15}))
    first = int(problem.fit[0])
    shape = problem.simulator.segments[first].position.shape
    by = floors * problem.signal_floor[: shape[1]]

    def refine_at(self: Problem, hypothesis: Hypothesis) -> None:
        assert hypothesis is rough.hypothesis
        none = np.zeros(shape)
        self.discretization_error = {first: Predicted(none + by, none, none)}

    none = np.zeros(shape)
    monkeypatch.setattr(problem, "discretization_error", {first: Predicted(none, none, none)})
    monkeypatch.setattr(Problem, "refine_at", refine_at)
    own = comparison.fit_with_own_correction(rough, comparison.weights(comparison.nominal))
    (here,), (there,) = own.hypothesis.theta, rough.hypothesis.theta
    assert bool(here != there) is fitted_on


def test_those_that_come_close_are_judged_eachfit_with_own_correction(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison = ModelComparison(problem)
    asked: list[tuple[Term, ...]] = []

    def at_its_own(self: ModelComparison, rival: ScoredModel, weights: FloatArray) -> ScoredModel:
        asked.append(rival.hypothesis.terms)
        return rival

    monkeypatch.setattr(ModelComparison, "fit_with_own_correction", at_its_own)
    weights = comparison.weights(comparison.nominal)
    right = with_true(problem, DRAG, {"coefficient": 0.15})
    more = right.with_term(ELSEWHERE, np.array([1e-4]))
    far = with_true(problem, DRY, {"coulomb": 0.2})
    found = comparison.race([right, more, far], weights, comparison.nominal)
    assert sorted(asked) == sorted([right.terms, more.terms])
    assert found[0].hypothesis.terms == right.terms
    # Nobody comes near one that is far ahead.
    asked.clear()
    comparison.race([right, far], weights, comparison.nominal)
    assert asked == []
