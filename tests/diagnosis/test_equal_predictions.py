"""Sets of effects that predict the same share the confidence."""

from __future__ import annotations

import numpy as np
import pytest
from searched import searched
from simulated_robots import MOTOR, PENDULUM, PLANAR, SERVO, SLIDER, problem_of

from pytest_twin.diagnosis.search.posterior import posterior
from pytest_twin.estimation.hypothesis import Term

FIRST, SECOND, ROBOT = 0, 1, -1
DELAYS = [Term("command_delay", joint) for joint in (FIRST, SECOND)]
SENSOR_DELAY = Term("sensor_delay", ROBOT)
LATE = {"delay": 0.02}


@pytest.mark.parametrize(
    ("robot", "mode", "hidden", "equal"),
    [
        pytest.param(
            PENDULUM.format(drive=SERVO), "position", {DELAYS[0]: LATE},
            [{DELAYS[0]}, {SENSOR_DELAY}], id="delay of one joint",
        ),
        pytest.param(
            PLANAR, "position", {DELAYS[0]: LATE, DELAYS[1]: LATE},
            [{*DELAYS}, {SENSOR_DELAY}], id="delay of all commands",
        ),
        pytest.param(
            SLIDER, "position", {Term("controller_gain", FIRST): {"stiffness_error": -0.3}},
            [{Term("controller_gain", FIRST)}], id="servo gain",
        ),
        pytest.param(
            PENDULUM.format(drive=MOTOR), "effort",
            {Term("torque_constant", FIRST): {"relative_error": -0.2}},
            [{Term("torque_constant", FIRST)}], id="torque constant",
        ),
    ],
)  # fmt: skip
def test_sets_with_equal_predictions_share_the_confidence(
    robot: str, mode: str, hidden: dict[Term, dict[str, float]], equal: list[set[Term]]
) -> None:
    found = searched(problem_of(robot, mode, hidden))
    own = {*found.incumbent.hypothesis.terms}
    assert own in equal
    shares = posterior(found)
    others = [s for s in equal if s != own]
    for term in own:
        assert shares.confidence[term] == pytest.approx(1.0 / len(equal), abs=0.1)
        alternatives = [set(a.new) for a in shares.alternatives[term] if a.confidence > 0.2]
        assert alternatives == [s - own for s in others]


def test_a_delay_of_one_of_two_joints_is_no_sensor_delay() -> None:
    found = searched(problem_of(PLANAR, "position", {DELAYS[0]: LATE}))
    assert found.incumbent.hypothesis.terms == (DELAYS[0],)
    assert posterior(found).confidence[DELAYS[0]] > 0.95
    assert np.isfinite(found.incumbent.score)
