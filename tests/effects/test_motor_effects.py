"""Motor effects on a pendulum with a servo, compared with an independent integration."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Predicted, Segment
from pytest_twin.estimation.hypothesis import Hypothesis, Scales, Term, effect_values

KP, MASS, LENGTH, ARMATURE, STEP = 1.5, 0.5, 0.1, 0.001, 0.001
WEIGHT, INERTIA = MASS * 9.81 * LENGTH, MASS * LENGTH**2 + ARMATURE
NAMES = ("torque_rolloff", "watchdog_timeout", "motor_load_friction")


def pendulum(damping: float) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>'
        f'<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="1e-9 1e-9 1e-9"/>'
        f'<joint name="j" axis="0 -1 0" damping="{damping}" armature="{ARMATURE}"/></body>'
        f'</worldbody><actuator><position joint="j" kp="{KP}"/></actuator></mujoco>'
    )


def simulated(
    command: FloatArray, values: dict[str, dict[str, float]], *, damping: float, start: float = 0.0
) -> Predicted:
    """Prediction at every step under setpoints (steps,), rad, held over each step."""
    time: FloatArray = STEP * np.arange(len(command), dtype=np.float64)
    segment = Segment(
        trial=0, model=pendulum(damping), mode="position", start=0.0, time=time,
        position=np.zeros((len(time), 1)), velocity=None, effort=None,
        command_time=time, command=command[:, None],
        initial_position=np.array([start]), initial_velocity=np.zeros(1),
    )  # fmt: skip
    terms = tuple(Term(e, 0) for e in sorted(values))
    theta = np.array([values[t.effect][p.name] for t in terms for p in t.parameters])
    scales = Scales({p.reference: np.ones(1) for t in terms for p in t.parameters})
    rows = effect_values([Hypothesis(terms, theta)], 1, scales)
    return BatchSimulator([segment], ("j",), threads=1).simulate(np.array([0]), rows)[0]


def reference(
    command: FloatArray, *, damping: float = 0.0, back_emf: float = 0.0, inverse_knee: float = 0.0,
    off_from: float = np.inf, start: float = 0.0, smoothed: float = 1e-9, unheard: float = 0.0,
) -> FloatArray:  # fmt: skip
    """(steps,) position, rad, by semi-implicit Euler at 1/20 of the step, without package code."""
    fine, q, v, out, heard = 20, start, 0.0, [], command[0]
    for k, wanted in enumerate(command):
        out.append(q)
        for i in range(fine):
            on = (k + i / fine) * STEP < off_from
            heard += (wanted - heard) * -np.expm1(-STEP / fine / smoothed)
            drive = (KP * (heard - q) - back_emf * v) * on
            drive = np.sign(drive) * max(abs(drive) - unheard, 0.0)
            torque = drive / (1.0 + abs(drive) * inverse_knee)
            v += STEP / fine * (torque - WEIGHT * np.sin(q) - damping * v) / INERTIA
            q += STEP / fine * v
    return np.array(out)


def ramp(seconds: float, top: float, stop: float) -> FloatArray:
    time = STEP * np.arange(round(seconds / STEP))
    path: FloatArray = top * np.minimum(time / stop, 1.0)
    return path


def test_watchdog_timeout_removes_drive_torque_and_back_emf_damping() -> None:
    command = ramp(2.0, 1.0, 0.6)
    values = {"watchdog_timeout": {"inverse_timeout": 10.0, "back_emf": 0.05}}
    found = simulated(command, values, damping=0.06).position[:, 0]
    expected = reference(command, damping=0.01, back_emf=0.05, off_from=0.702)
    assert np.abs(found - expected).max() < 0.02
    braked = reference(command, damping=0.06, off_from=0.702)
    assert np.abs(found - braked).max() > 0.1


def test_a_changing_command_enables_the_drive_again_after_a_timeout() -> None:
    command = np.concatenate([ramp(1.0, 0.5, 0.2), np.linspace(0.5, 0.9, 1500)])
    values = {"watchdog_timeout": {"inverse_timeout": 5.0, "back_emf": 0.0}}
    found = simulated(command, values, damping=0.2).position[:, 0]
    assert abs(found[990]) < 0.1 < found[-1]
    assert found[-1] == pytest.approx(reference(command, damping=0.2)[-1], abs=0.01)


def test_a_smoothed_setpoint_is_a_first_order_lag_of_the_command() -> None:
    command = ramp(2.0, 1.0, 0.6)
    values = {"actuator_lag": {"time_constant": 0.08, "of_setpoint": 1.0}}
    found = simulated(command, values, damping=0.1).position[:, 0]
    assert np.abs(found - reference(command, damping=0.1, smoothed=0.08)).max() < 2e-3
    # A lag of the effort gives another motion: it oscillates.
    lagging = {"actuator_lag": {"time_constant": 0.08, "of_setpoint": 0.0}}
    assert np.abs(found - simulated(command, lagging, damping=0.1).position[:, 0]).max() > 0.05


def test_dead_zone_of_effort_removes_efforts_below_gain_times_width() -> None:
    """In a servo with damping this differs from a dead zone of the position error."""
    command = ramp(2.0, 1.0, 0.6)
    values = {"dead_zone": {"width": 0.1, "of_effort": 1.0}}
    found = simulated(command, values, damping=0.1).position[:, 0]
    expected = reference(command, damping=0.1, unheard=0.1 * KP)
    assert np.abs(found - expected).max() < 2e-3
    assert np.abs(found - reference(command, damping=0.1)).max() > 0.05
    # Without damping in the servo the error and the effort are the same.
    of_error = {"dead_zone": {"width": 0.1, "of_effort": 0.0}}
    assert np.allclose(found, simulated(command, of_error, damping=0.1).position[:, 0], atol=1e-9)


def test_motor_load_friction_without_stiction_equals_load_dependent_friction_of_the_drive() -> None:
    command = ramp(2.0, 1.0, 0.6)
    even = {"coefficient": 0.3, "stiction_excess": 0.0, "stribeck_velocity": 0.2}
    plain = {"coefficient": 0.3, "of_drive": 1.0}
    found = simulated(command, {"motor_load_friction": even}, damping=0.1).position
    other = simulated(command, {"load_dependent_friction": plain}, damping=0.1).position
    assert np.allclose(found, other, atol=1e-12)
    by_load = simulated(
        command, {"load_dependent_friction": {**plain, "of_drive": 0.0}}, damping=0.1
    )
    assert np.abs(by_load.position - found).max() > 0.01


@pytest.mark.parametrize("inverse_knee", [0.5, 2.0])
def test_torque_rolloff_reduces_large_requested_efforts(inverse_knee: float) -> None:
    command = ramp(3.0, 1.2, 0.5)
    values = {"torque_rolloff": {"inverse_knee": inverse_knee, "back_emf": 0.05}}
    found = simulated(command, values, damping=0.1).position[:, 0]
    expected = reference(command, damping=0.05, back_emf=0.05, inverse_knee=inverse_knee)
    assert np.abs(found - expected).max() < 3e-3
    # At rest the reduced effort balances gravity.
    asked = KP * (1.2 - found[-1])
    carried = asked / (1.0 + asked * inverse_knee)
    assert carried == pytest.approx(WEIGHT * np.sin(found[-1]), abs=2e-3)
    assert np.abs(found[-1] - reference(command, damping=0.05)[-1]) > 0.03


def test_motor_load_friction_holds_the_link_until_the_break_away_effort() -> None:
    friction = {"coefficient": 0.2, "stiction_excess": 0.3, "stribeck_velocity": 0.2}
    values = {"motor_load_friction": friction}

    def rests(wanted: float) -> bool:
        start = 0.5
        path = simulated(np.full(400, wanted), values, damping=0.05, start=start).position[:, 0]
        return bool(np.abs(path - start).max() < 1e-3)

    weight = WEIGHT * np.sin(0.5)
    # It breaks away upwards at a motor torque above weight / (1 - 0.5).
    assert rests(0.5 + 0.95 * weight / 0.5 / KP)
    assert not rests(0.5 + 1.1 * weight / 0.5 / KP)
    # It breaks away downwards at a motor torque below weight / (1 + 0.5).
    assert rests(0.5 + 1.05 * weight / 1.5 / KP)
    assert not rests(0.5 + 0.9 * weight / 1.5 / KP)


def test_motor_load_friction_is_zero_when_the_motor_is_off() -> None:
    friction = {"coefficient": 0.4, "stiction_excess": 0.2, "stribeck_velocity": 0.2}
    values = {
        "motor_load_friction": friction,
        "watchdog_timeout": {"inverse_timeout": 140.0, "back_emf": 0.0},
    }
    found = simulated(np.zeros(1500), values, damping=0.0, start=0.6).position[:, 0]
    free = reference(np.zeros(1500), off_from=0.008, start=0.6)
    assert np.abs(found[-800:]).max() == pytest.approx(np.abs(free[-800:]).max(), abs=0.05)


@pytest.mark.parametrize("name", NAMES)
def test_neutral_values_change_nothing(name: str) -> None:
    law = catalogue()[name]
    neutral = {p.name: p.starts[0] if p.neutral is None else p.neutral for p in law.parameters}
    command = ramp(0.6, 0.8, 0.3)
    found = simulated(command, {name: neutral}, damping=0.05).position
    assert np.array_equal(found, simulated(command, {}, damping=0.05).position)
    for p in law.parameters:
        assert p.lower <= min(p.starts) <= max(p.starts) <= p.upper
