"""One limit of a drive for another: what no slope leads to, where the drive is at a limit."""

from __future__ import annotations

import numpy as np
from test_first_order import ELBOW, SHOULDER, problem_of

from pytest_twin.diagnosis.hypothesis import EMPTY, Term
from pytest_twin.diagnosis.search.contest import Contest
from pytest_twin.diagnosis.search.limits import is_limit, limits_instead

PROFILE = {"inverse_rate": 3.0, "inverse_effort_rate": 0.0, "of_effort": 0.0}
SLOW, WEAK = Term("rate_limit", ELBOW), Term("torque_speed_limit", ELBOW)


def test_a_weak_drive_gives_way_to_the_setpoint_that_moves_slowly() -> None:
    problem = problem_of("position", {SLOW: PROFILE})
    contest = Contest(problem)
    scales = [problem.scales.value(p, ELBOW) for p in WEAK.parameters]
    start = EMPTY.with_term(WEAK, np.array([1.0 / (0.4 * scales[0]), 1.0]))
    best = contest.settled(contest.as_it_is(start))
    assert best.left[ELBOW] > (5.0 * problem.floor[ELBOW]) ** 2
    (other,) = limits_instead(problem, best, set())
    assert other.terms == (SLOW,)
    assert abs(other.theta[0] * problem.scales.value(SLOW.parameters[0], ELBOW) - 3.0) < 0.1
    # Each is asked about once.
    assert limits_instead(problem, best, {WEAK}) == []


def test_a_limit_that_explains_its_joint_is_not_asked_about() -> None:
    problem = problem_of("position", {SLOW: PROFILE})
    contest = Contest(problem)
    size = 3.0 / problem.scales.value(SLOW.parameters[0], ELBOW)
    best = contest.settled(contest.as_it_is(EMPTY.with_term(SLOW, np.array([size, 0.0, 0.0]))))
    assert limits_instead(problem, best, set()) == []


def test_what_bends_sharply_elsewhere_is_no_limit() -> None:
    limits = {"rate_limit", "torque_saturation", "torque_speed_limit"}
    others = {"cogging", "external_force", "joint_coupling", "viscous_friction"}
    assert all(is_limit(Term(effect, SHOULDER)) for effect in limits)
    assert not any(is_limit(Term(effect, SHOULDER)) for effect in others)
