"""The same physics in fewer words."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import ELBOW, ROBOT, SHOULDER, problem_of

from pytest_twin.diagnosis.fewer import merged, of_the_robot
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem

LATE = [Term("command_delay", j) for j in (SHOULDER, ELBOW)]
DRY = Term("coulomb_friction", ELBOW)
PLAY, SOFT = Term("backlash", ELBOW), Term("joint_elasticity", ELBOW)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {DRY: {"coulomb": 0.1}})


def of(*terms: tuple[Term, list[float]]) -> Hypothesis:
    found = EMPTY
    for term, theta in terms:
        found = found.with_term(term, np.array(theta))
    return found


def test_late_commands_at_every_joint_may_be_late_sensors(problem: Problem) -> None:
    everywhere = of((LATE[0], [0.02]), (DRY, [0.1]), (LATE[1], [0.03]))
    (late,) = of_the_robot(problem, everywhere)
    assert late.terms == (DRY, Term("sensor_delay", ROBOT))
    # It starts as late as they are: where efforts jump, a search from afar would not find there.
    assert late.theta == pytest.approx([0.1, 0.025])
    # One joint whose commands are late is that joint's.
    assert of_the_robot(problem, everywhere.without(LATE[0])) == []


def test_an_elastic_gear_beside_play_is_its_teeth(problem: Problem) -> None:
    (both,) = merged(problem, of((PLAY, [0.03, 0.002]), (SOFT, [0.004, 0.01])))
    assert both.terms == (PLAY,)
    assert both.theta == pytest.approx([0.03, 0.006])
    # More than teeth can yield stays within their bounds, and leaves what it does to be seen.
    (soft,) = merged(problem, of((PLAY, [0.03, 0.002]), (SOFT, [0.3, 0.01])))
    assert soft.theta[1] == PLAY.parameters[1].upper
