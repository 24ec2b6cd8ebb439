"""A gain that acts like a torque constant: counted alike, and stated as the setting that it is."""

from __future__ import annotations

import numpy as np
from simulated_robots import PENDULUM, SERVO, problem_of

from pytest_twin.diagnosis.search.common_effects import idle_parameters, set_size
from pytest_twin.diagnosis.search.simplification import as_settings
from pytest_twin.estimation.hypothesis import EMPTY, Term

GAIN, CONSTANT = Term("controller_gain", 0), Term("torque_constant", 0)


def test_the_damping_of_a_servo_without_damping_counts_as_no_parameter() -> None:
    undamped = SERVO.replace('kv="', 'kv="0" user="')
    sizes = []
    for drive in (SERVO, undamped):
        problem = problem_of(PENDULUM.format(drive=drive), "position", {})
        gain = EMPTY.with_term(GAIN, np.array([-0.5, 0.0]))
        sizes.append(set_size(problem, gain, idle_parameters(problem, [GAIN])).parameters)
    assert sizes == [2, 1]


def test_a_torque_constant_of_a_servo_can_be_stated_as_its_gain() -> None:
    problem = problem_of(PENDULUM.format(drive=SERVO), "position", {})
    (restated,) = as_settings(problem, EMPTY.with_term(CONSTANT, np.array([-0.4])))
    assert restated.terms == (GAIN,)
    np.testing.assert_allclose(restated.theta, [-0.4, -0.4])
    assert as_settings(problem, restated) == []
