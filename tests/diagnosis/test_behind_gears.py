"""Gears that give: found where the motion along which laws are read off says little of them."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import ELBOW, link, problem_of

from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.compensated_starts import compensated
from pytest_twin.diagnosis.search.contest import Contest
from pytest_twin.diagnosis.search.foremost import foremost
from pytest_twin.diagnosis.search.front import front
from pytest_twin.diagnosis.search.look import look_ahead
from pytest_twin.diagnosis.search.rivals import Rival
from pytest_twin.diagnosis.search.tryout import Tryout

PLAY, FRICTION, LATE = (
    Term(effect, ELBOW) for effect in ("backlash", "asymmetric_friction", "command_delay")
)
TEETH = {"gap": 0.04, "tooth_compliance": 1e-4}
DRY = {"coulomb": 0.25, "offset": 0.15}


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
    found = foremost(contest, best, look)
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
    found = foremost(contest, best, look)
    assert found is not None
    assert PLAY in {h.terms[-1] for h in front(problem, best, look, found)}


GIVES, LINK = Term("joint_elasticity", ELBOW), Term("inertial_parameters", ELBOW)
SOFT = {"compliance": 1.0 / 12.0, "damping_time": 0.01}


def tried(problem: Problem, best: Rival) -> list[Hypothesis]:
    left = np.mean(best.fitted.residual**2, axis=0)
    return compensated(Tryout(problem, best, left), best.hypothesis)


def test_a_heavier_link_is_tried_with_its_gear_as_much_stiffer() -> None:
    error = 0.4
    problem = problem_of("position", {GIVES: SOFT, LINK: link(0, relative_error=error)})
    contest = Contest(problem)
    # The stiffness at which a link as the model has it swings as the real one does.
    servo = 1.0 / problem.simulator.models.world(problem.fit).stiffness[0, ELBOW]
    swings = SOFT | {"compliance": (SOFT["compliance"] + servo) * (1.0 + error) - servo}
    best = fitted(contest, with_true(problem, GIVES, swings))
    (found,) = tried(problem, best)
    truth = with_true(problem, GIVES, SOFT).theta
    assert found.terms == (GIVES, LINK)
    assert found.theta[:2] == pytest.approx(truth, rel=0.02)
    assert found.theta[found.slice_of(LINK)][0] == pytest.approx(error, rel=0.02)
    look = look_ahead(problem, best)
    seen = foremost(contest, best, look)
    assert seen is not None
    (start,) = (h for h in front(problem, best, look, seen) if h.terms == found.terms)
    assert start.theta[:2] == pytest.approx(truth, rel=0.05)
    # With a link that is right, or named, or without a gear nothing of it is tried.
    right = problem_of("position", {GIVES: SOFT})
    fits = fitted(Contest(right), with_true(right, GIVES, SOFT))
    assert tried(right, fits) == []
    assert tried(problem, fitted(contest, found)) == []
    assert tried(problem, fitted(contest, EMPTY)) == []
