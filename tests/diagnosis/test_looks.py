"""What is seen to first order around a fit serves around another nearby."""

from __future__ import annotations

import pytest
from test_behind_gears import fitted, with_true
from test_first_order import ELBOW, SHOULDER, problem_of

from pytest_twin.diagnosis.first_order.responses import Linear
from pytest_twin.diagnosis.first_order.screen import candidates
from pytest_twin.diagnosis.hypothesis import Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.contest import Contest
from pytest_twin.diagnosis.search.look import look_around

DRAG, DRY = Term("viscous_friction", ELBOW), Term("coulomb_friction", SHOULDER)
HIDDEN = {DRAG: {"coefficient": 0.2}, DRY: {"coulomb": 0.3}}


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", HIDDEN)


def test_a_look_from_nearby_is_not_taken_again(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    contest = Contest(problem)
    before = look_around(problem, contest.nominal)
    best = fitted(contest, with_true(problem, DRAG, HIDDEN[DRAG]))
    fresh = look_around(problem, best)
    taken: list[Term] = []
    monkeypatch.setattr(Linear, "responses", lambda self, terms: taken.extend(terms) or [])
    served = look_around(problem, best, before)
    assert taken == []
    # The view is of the fit at hand, and what it has named is no candidate any more.
    assert served.view.residual == pytest.approx(fresh.view.residual)
    assert served.asked == fresh.asked == frozenset(candidates(problem)) - {DRAG}
    assert {r.term for r in served.answers.responses} == {r.term for r in fresh.answers.responses}
    # What the other fit had named has no response there: it is asked here.
    look_around(problem, contest.nominal, fresh)
    assert taken == [DRAG]
