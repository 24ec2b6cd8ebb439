"""What a motor makes of its drive, held against equations of its own: a pendulum on a servo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis, Scales, Term, effect_values
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Predicted, Segment

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


def swing(
    command: FloatArray, values: dict[str, dict[str, float]], *, damping: float, start: float = 0.0
) -> Predicted:
    """Positions at every step under setpoints (steps,) that are held from step to step."""
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
    """The same, semi-implicit at a twentieth of the step; no part of the package."""
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


def test_a_drive_that_lets_go_takes_its_back_emf_along() -> None:
    command = ramp(2.0, 1.0, 0.6)
    values = {"watchdog_timeout": {"inverse_timeout": 10.0, "back_emf": 0.05}}
    found = swing(command, values, damping=0.06).position[:, 0]
    expected = reference(command, damping=0.01, back_emf=0.05, off_from=0.702)
    assert np.abs(found - expected).max() < 0.02
    braked = reference(command, damping=0.06, off_from=0.702)
    assert np.abs(found - braked).max() > 0.1


def test_a_command_that_moves_again_wakes_the_drive() -> None:
    command = np.concatenate([ramp(1.0, 0.5, 0.2), np.linspace(0.5, 0.9, 1500)])
    values = {"watchdog_timeout": {"inverse_timeout": 5.0, "back_emf": 0.0}}
    found = swing(command, values, damping=0.2).position[:, 0]
    assert abs(found[990]) < 0.1 < found[-1]
    assert found[-1] == pytest.approx(reference(command, damping=0.2)[-1], abs=0.01)


def test_a_smoothed_setpoint_follows_its_command() -> None:
    command = ramp(2.0, 1.0, 0.6)
    values = {"actuator_lag": {"time_constant": 0.08, "of_setpoint": 1.0}}
    found = swing(command, values, damping=0.1).position[:, 0]
    assert np.abs(found - reference(command, damping=0.1, smoothed=0.08)).max() < 2e-3
    # Not what a lag of the effort makes of it: that one swings.
    lagging = {"actuator_lag": {"time_constant": 0.08, "of_setpoint": 0.0}}
    assert np.abs(found - swing(command, lagging, damping=0.1).position[:, 0]).max() > 0.05


def test_small_efforts_are_not_given() -> None:
    """Beyond gain times width: of a servo with damping another law than that of its error."""
    command = ramp(2.0, 1.0, 0.6)
    values = {"dead_zone": {"width": 0.1, "of_effort": 1.0}}
    found = swing(command, values, damping=0.1).position[:, 0]
    expected = reference(command, damping=0.1, unheard=0.1 * KP)
    assert np.abs(found - expected).max() < 2e-3
    assert np.abs(found - reference(command, damping=0.1)).max() > 0.05
    # Without damping in the servo the error and the effort are the same.
    of_error = {"dead_zone": {"width": 0.1, "of_effort": 0.0}}
    assert np.allclose(found, swing(command, of_error, damping=0.1).position[:, 0], atol=1e-9)


def test_friction_by_the_motor_that_does_not_fall_is_friction_by_its_load() -> None:
    command = ramp(2.0, 1.0, 0.6)
    even = {"coefficient": 0.3, "stiction_excess": 0.0, "stribeck_velocity": 0.2}
    plain = {"coefficient": 0.3, "of_drive": 1.0}
    found = swing(command, {"motor_load_friction": even}, damping=0.1).position
    other = swing(command, {"load_dependent_friction": plain}, damping=0.1).position
    assert np.allclose(found, other, atol=1e-12)
    by_load = swing(command, {"load_dependent_friction": {**plain, "of_drive": 0.0}}, damping=0.1)
    assert np.abs(by_load.position - found).max() > 0.01


@pytest.mark.parametrize("inverse_knee", [0.5, 2.0])
def test_effort_rolls_off_with_what_the_drive_asks_for(inverse_knee: float) -> None:
    command = ramp(3.0, 1.2, 0.5)
    values = {"torque_rolloff": {"inverse_knee": inverse_knee, "back_emf": 0.05}}
    found = swing(command, values, damping=0.1).position[:, 0]
    expected = reference(command, damping=0.05, back_emf=0.05, inverse_knee=inverse_knee)
    assert np.abs(found - expected).max() < 3e-3
    # At rest: the rolled-off effort carries the weight.
    asked = KP * (1.2 - found[-1])
    carried = asked / (1.0 + asked * inverse_knee)
    assert carried == pytest.approx(WEIGHT * np.sin(found[-1]), abs=2e-3)
    assert np.abs(found[-1] - reference(command, damping=0.05)[-1]) > 0.03


def test_friction_by_the_motor_holds_what_its_effort_allows() -> None:
    friction = {"coefficient": 0.2, "stiction_excess": 0.3, "stribeck_velocity": 0.2}
    values = {"motor_load_friction": friction}

    def rests(wanted: float) -> bool:
        start = 0.5
        path = swing(np.full(400, wanted), values, damping=0.05, start=start).position[:, 0]
        return bool(np.abs(path - start).max() < 1e-3)

    weight = WEIGHT * np.sin(0.5)
    # Raised, it breaks away where the motor gives more than weight / (1 - 0.5).
    assert rests(0.5 + 0.95 * weight / 0.5 / KP)
    assert not rests(0.5 + 1.1 * weight / 0.5 / KP)
    # Lowered, where it gives less than weight / (1 + 0.5).
    assert rests(0.5 + 1.05 * weight / 1.5 / KP)
    assert not rests(0.5 + 0.9 * weight / 1.5 / KP)


def test_friction_by_the_motor_is_gone_with_the_motor_off() -> None:
    friction = {"coefficient": 0.4, "stiction_excess": 0.2, "stribeck_velocity": 0.2}
    values = {
        "motor_load_friction": friction,
        "watchdog_timeout": {"inverse_timeout": 140.0, "back_emf": 0.0},
    }
    found = swing(np.zeros(1500), values, damping=0.0, start=0.6).position[:, 0]
    free = reference(np.zeros(1500), off_from=0.008, start=0.6)
    assert np.abs(found[-800:]).max() == pytest.approx(np.abs(free[-800:]).max(), abs=0.05)


@pytest.mark.parametrize("name", NAMES)
def test_neutral_values_change_nothing(name: str) -> None:
    law = catalogue()[name]
    neutral = {p.name: p.starts[0] if p.neutral is None else p.neutral for p in law.parameters}
    command = ramp(0.6, 0.8, 0.3)
    found = swing(command, {name: neutral}, damping=0.05).position
    assert np.array_equal(found, swing(command, {}, damping=0.05).position)
    for p in law.parameters:
        assert p.lower <= min(p.starts) <= max(p.starts) <= p.upper
