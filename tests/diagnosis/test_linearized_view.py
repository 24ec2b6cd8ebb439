"""The sensitivities around one fit are reused around a similar fit."""

from __future__ import annotations

import pytest
from test_elastic_transmissions import scored_model, single_effect
from test_first_order import ELBOW, SHOULDER, problem_of

from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.sensitivities import Linear
from pytest_twin.diagnosis.hypothesis import Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.linearized_view import linearize_around
from pytest_twin.diagnosis.search.model_comparison import ModelComparison

DRAG, DRY = Term("viscous_friction", ELBOW), Term("coulomb_friction", SHOULDER)
HIDDEN = {DRAG: {"coefficient": 0.2}, DRY: {"coulomb": 0.3}}


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", HIDDEN)


def test_sensitivities_around_a_similar_fit_are_reused_instead_of_computed_again(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison = ModelComparison(problem)
    before = linearize_around(problem, comparison.nominal)
    best = scored_model(comparison, single_effect(problem, DRAG, HIDDEN[DRAG]))
    fresh = linearize_around(problem, best)
    computed: list[Term] = []
    monkeypatch.setattr(Linear, "sensitivities", lambda self, terms: computed.extend(terms) or [])
    reused = linearize_around(problem, best, before)
    assert computed == []
    # The residual is that of the current fit, and the effect in this fit is no candidate.
    assert reused.view.residual == pytest.approx(fresh.view.residual)
    assert reused.evaluated == fresh.evaluated == frozenset(candidates(problem)) - {DRAG}
    assert {r.term for r in reused.candidate_sensitivities.responses} == {
        r.term for r in fresh.candidate_sensitivities.responses
    }
    # The effect in the other fit has no sensitivity there, so it is computed.
    linearize_around(problem, comparison.nominal, fresh)
    assert computed == [DRAG]
