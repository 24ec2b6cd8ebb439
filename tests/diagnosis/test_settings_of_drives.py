"""A gain that acts like a torque constant: counted alike, and stated as the setting that it is."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from simulated_robots import PENDULUM, SERVO, problem_of

from pytest_twin.diagnosis.search.common_effects import idle_parameters, set_size
from pytest_twin.diagnosis.search.model import PooledModel
from pytest_twin.diagnosis.search.posterior import Exchange, distinct
from pytest_twin.diagnosis.search.simplification import as_settings
from pytest_twin.estimation.comparison import Size
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


@pytest.mark.parametrize(("error", "odds"), [(0.1, 1.25), (-0.47, 135.0), (1.2, 3e5)])
def test_a_torque_constant_far_from_the_right_one_is_less_likely_than_a_gain(
    error: float, odds: float
) -> None:
    """Odds of a gain that predicts the same: normal with 15 %, at most those of five deviations."""
    undamped = SERVO.replace('kv="', 'kv="0" user="')
    problem = problem_of(PENDULUM.format(drive=undamped), "position", {})
    idle = idle_parameters(problem, [GAIN])
    constant = set_size(problem, EMPTY.with_term(CONSTANT, np.array([error])), idle)
    gain = set_size(problem, EMPTY.with_term(GAIN, np.array([error, 0.0])), idle)
    assert constant == gain
    assert np.exp(constant.surprise - gain.surprise) == pytest.approx(odds, rel=0.15)


def test_a_gain_that_needs_no_more_parameters_shares_with_a_torque_constant() -> None:
    """With more of them, it contains the torque constant, and takes nothing from it."""
    incumbent = Size(1, 1)
    model = SimpleNamespace(hypothesis=EMPTY.with_term(CONSTANT, np.array([-0.4])), size=incumbent)

    def exchanges(parameters: int) -> list[Exchange]:
        gain = EMPTY.with_term(GAIN, np.array([-0.4, 0.0]))
        return distinct(model, [PooledModel(gain, Size(1, parameters), 0.0)], lambda rival: 0.0)  # type: ignore[arg-type]

    (other,) = exchanges(1)
    assert (other.removed, other.added) == (frozenset({CONSTANT}), frozenset({GAIN}))
    assert exchanges(2) == []
