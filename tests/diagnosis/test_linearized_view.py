"""What is seen to first order around a fit serves around another nearby."""

from __future__ import annotations

import pytest
from test_behind_gears import fitted, with_true
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


def test_a_look_from_nearby_is_not_taken_again(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison = ModelComparison(problem)
    before = linearize_around(problem, comparison.nominal)
    best = fitted(comparison, with_true(problem, DRAG, HIDDEN[DRAG]))
    fresh = linearize_around(problem, best)
    taken: list[Term] = []
    monkeypatch.setattr(Linear, "sensitivities", lambda self, terms: taken.extend(terms) or [])
    served = linearize_around(problem, best, before)
    assert taken == []
    # The view is of the fit at hand, and what it has named is no candidate any more.
    assert served.view.residual == pytest.approx(fresh.view.residual)
    assert served.evaluated == fresh.evaluated == frozenset(candidates(problem)) - {DRAG}
    assert {r.term for r in served.candidate_sensitivities.responses} == {
        r.term for r in fresh.candidate_sensitivities.responses
    }
    # What the other fit had named has no response there: it is asked here.
    linearize_around(problem, comparison.nominal, fresh)
    assert taken == [DRAG]
