"""Gears that give: found where the motion along which laws are read off says little of them."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import ELBOW, problem_of

from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.contest import Contest
from pytest_twin.diagnosis.search.foremost import foremost
from pytest_twin.diagnosis.search.front import front
from pytest_twin.diagnosis.search.look import look_ahead
from pytest_twin.diagnosis.search.rivals import Rival

PLAY, FRICTION, LATE = (
    Term(effect, ELBOW) for effect in ("backlash", "asymmetric_friction", "command_delay")
)
TEETH = {"gap": 0.04, "tooth_compliance": 1e-4}
DRY = {"coulomb": 0.25, "offset": 0.15}


def silent(text: str) -> None:
    del text


def with_true(problem: Problem, term: Term, values: dict[str, float]) -> Hypothesis:
    theta = [values[p.name] / problem.scales.value(p, term.joint) for p in term.parameters]
    return EMPTY.with_term(term, np.array(theta))


def fitted(contest: Contest, hypothesis: Hypothesis) -> Rival:
    weights = contest.weights(contest.nominal)
    return contest.rivals([hypothesis], weights, 0, slopes=True)[0]


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {PLAY: TEETH, FRICTION: DRY})


def test_what_acts_on_a_motor_behind_play_is_simulated(problem: Problem) -> None:
    contest = Contest(problem)
    best = fitted(contest, with_true(problem, PLAY, TEETH))
    look = look_ahead(problem, best)
    assert look.linear is None
    found = foremost(contest, best, look, silent)
    assert found is not None
    assert (PLAY, FRICTION) in {h.terms for h in front(problem, best, look, found)}
    # Where no gear is named nothing but the laws along the motion is asked.
    assert look_ahead(problem, fitted(contest, EMPTY)).linear is not None


def test_play_beside_what_explains_more_is_tried_by_simulation() -> None:
    late = {"delay": 0.03}
    problem = problem_of("position", {LATE: late, PLAY: {"gap": 0.02, "tooth_compliance": 1e-4}})
    contest = Contest(problem)
    best = fitted(contest, with_true(problem, LATE, late))
    look = look_ahead(problem, best)
    found = foremost(contest, best, look, silent)
    assert found is not None
    assert PLAY in {h.terms[-1] for h in front(problem, best, look, found)}
