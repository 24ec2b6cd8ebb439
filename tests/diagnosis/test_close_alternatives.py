"""Models with similar evidence are compared with the discretization error of each."""

from __future__ import annotations

import numpy as np
import pytest
from test_elastic_transmissions import scored_model, single_effect
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


@pytest.mark.parametrize(
    ("floors", "fitted_again"),
    [(0.1, False), (1.0, True)],
    ids=["change of 0.1 floors", "change of 1 floor"],
)
def test_a_model_is_fitted_again_if_its_discretization_error_changes_its_prediction(
    problem: Problem, monkeypatch: pytest.MonkeyPatch, floors: float, fitted_again: bool
) -> None:
    comparison = ModelComparison(problem)
    inaccurate = scored_model(comparison, single_effect(problem, DRAG, {"coefficient": 0.15}))
    first = int(problem.fit[0])
    shape = problem.simulator.segments[first].position.shape
    by = floors * problem.signal_floor[: shape[1]]

    def refine_at(self: Problem, hypothesis: Hypothesis) -> None:
        assert hypothesis is inaccurate.hypothesis
        none = np.zeros(shape)
        self.discretization_error = {first: Predicted(none + by, none, none)}

    none = np.zeros(shape)
    monkeypatch.setattr(problem, "discretization_error", {first: Predicted(none, none, none)})
    monkeypatch.setattr(Problem, "refine_at", refine_at)
    own = comparison.fit_with_own_correction(inaccurate, comparison.weights(comparison.nominal))
    (here,), (there,) = own.hypothesis.theta, inaccurate.hypothesis.theta
    assert bool(here != there) is fitted_again


def test_only_models_with_similar_evidence_get_their_own_discretization_error(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison = ModelComparison(problem)
    corrected: list[tuple[Term, ...]] = []

    def record_model(self: ModelComparison, rival: ScoredModel, weights: FloatArray) -> ScoredModel:
        corrected.append(rival.hypothesis.terms)
        return rival

    monkeypatch.setattr(ModelComparison, "fit_with_own_correction", record_model)
    weights = comparison.weights(comparison.nominal)
    right = single_effect(problem, DRAG, {"coefficient": 0.15})
    more = right.with_term(ELSEWHERE, np.array([1e-4]))
    far = single_effect(problem, DRY, {"coulomb": 0.2})
    found = comparison.race([right, more, far], weights, comparison.nominal)
    assert sorted(corrected) == sorted([right.terms, more.terms])
    assert found[0].hypothesis.terms == right.terms
    # The best model has far more evidence than the other.
    corrected.clear()
    comparison.race([right, far], weights, comparison.nominal)
    assert corrected == []
