"""Effects with an internal state act with their mean over a step, for any step size.

Inputs are held over a coarse step. The reference uses steps 200 times finer with the same inputs.
"""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import World

STEP, STEPS, FINER = 0.01, 60, 200
# Effect, its parameters, and the simulation variable that it changes.
LAWS: list[tuple[str, dict[str, float], str]] = [
    ("actuator_lag", {"time_constant": 0.02, "of_setpoint": 0.0}, "delivered"),
    (
        "rate_limit",
        {"inverse_rate": 1.0 / 3.0, "inverse_effort_rate": 0.0, "of_effort": 0.0},
        "setpoint",
    ),
    (
        "rate_limit",
        {"inverse_rate": 0.0, "inverse_effort_rate": 1.0 / 30.0, "of_effort": 1.0},
        "delivered",
    ),
    ("presliding_hysteresis", {"coulomb": 0.4, "presliding_distance": 0.02}, "applied"),
]


def world(timestep: float) -> World:
    one = np.zeros((1, 1))
    return World(
        time=np.zeros(1), timestep=timestep, position=one, velocity=one, setpoint=one, gain=one,
        stiffness=one, damping=one, offset=one, lower=one - np.inf, upper=one + np.inf,
        servo=np.array(["position"]), delivered=one, friction_level=one, applied=one, load=one,
        motor_armature=one, motor_damping=one, motor_constant_effort=one,
        link_inertia=one + np.inf,
    )  # fmt: skip


def outputs(
    effect: str, of: dict[str, float], signal: str, inputs: FloatArray, timestep: float
) -> FloatArray:
    """(steps,) output of the effect for inputs held over each step."""
    law, at = catalogue()[effect], world(timestep)
    values = {n: np.full((1, 1), v) for n, v in of.items()}
    out = []
    for x in inputs:
        at.setpoint = at.delivered = at.velocity = np.full((1, 1), x)
        at.applied = np.zeros((1, 1))
        law.command(at, values)
        law.drive(at, values)
        law.force(at, values)
        out.append(float(getattr(at, signal)[0, 0]))
    return np.array(out)


@pytest.mark.parametrize(("effect", "of", "signal"), LAWS, ids=[f"{e}-{s}" for e, _, s in LAWS])
def test_an_effect_with_state_outputs_the_mean_of_200_finer_steps(
    effect: str, of: dict[str, float], signal: str
) -> None:
    inputs = np.cumsum(np.random.default_rng(3).normal(0.0, 0.3, STEPS))
    inputs[0] = 0.0
    coarse = outputs(effect, of, signal, inputs, STEP)
    finer = outputs(effect, of, signal, np.repeat(inputs, FINER), STEP / FINER)
    fine = finer.reshape(STEPS, FINER).mean(axis=1)
    assert np.abs(inputs - fine).max() > 0.1
    assert np.abs(coarse - fine).max() < 2e-3 * np.abs(fine).max()
    assert np.abs(np.mean(coarse - fine)) < 5e-3 * np.abs(fine).max()
