"""Servo effects compared with an independent integration of a pendulum on a digital servo."""

from __future__ import annotations

import functools
import math

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment

KP, KV, LIMIT, MASS, LENGTH, ARMATURE = 6.0, 0.3, 3.0, 0.5, 0.1, 0.005
WEIGHT, INERTIA = MASS * 9.81 * LENGTH, MASS * LENGTH**2 + ARMATURE
STEP, FINE, SECONDS = 0.002, 8, 1.5
RANGE = 0.7


def model(servo: str, attributes: str = "") -> mujoco.MjModel:
    gains = {"position": f'kp="{KP}" kv="{KV}"', "velocity": f'kv="{KV}"'}[servo]
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>'
        f'<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="1e-9 1e-9 1e-9"/>'
        f'<joint name="j" axis="0 -1 0" armature="{ARMATURE}"/></body></worldbody><actuator>'
        f'<{servo} joint="j" {gains} forcerange="-{LIMIT} {LIMIT}" {attributes}/></actuator>'
        "</mujoco>"
    )


def commands() -> tuple[FloatArray, FloatArray]:
    """Stamps (s) and setpoints (rad), held for 10 ms: a sine and two steps."""
    stamps: FloatArray = 0.01 * np.arange(round(SECONDS / 0.01), dtype=np.float64)
    swing = 0.5 * np.sin(2.0 * np.pi * 1.7 * stamps)
    return stamps, swing * (stamps < 0.8) + 0.4 * (stamps > 0.9) - 0.6 * (stamps > 1.2)


def positions(
    effect: str, values: dict[str, float], servo: str = "position", refine: int = FINE,
    attributes: str = "", start: float = 0.0, moving: bool = False,
) -> FloatArray:  # fmt: skip
    """(samples,) position, rad, every 10 ms; without the effect if its values are empty."""
    stamps, command = commands()
    segment = Segment(
        trial=0, model=model(servo, attributes), mode=servo, start=0.0, time=stamps,
        position=np.zeros((len(stamps), 1)), velocity=None, effort=None,
        command_time=stamps, command=command[:, None] * (1.0 if servo == "position" else 4.0),
        initial_position=np.full(1, start), initial_velocity=np.zeros(1), is_interpolated=moving,
    )  # fmt: skip
    simulator = BatchSimulator([segment], ("j",), threads=1, refine=refine)
    rows = {effect: {n: np.full((1, 1), v) for n, v in values.items()}} if values else {}
    return simulator.simulate(np.array([0]), rows)[0].position[:, 0]


def reference(
    *, filtered: float = 0.0, feedforward: float = 0.0, integral_time: float = np.inf,
    period: float = 0.0, late: float = 0.0, phase: float = 0.0, servo: str = "position",
    moving: bool = False,
) -> FloatArray:  # fmt: skip
    """(samples,) position, rad, by semi-implicit Euler at 40 us, without code of the package.

    Args:
        filtered: time constant of the velocity filter, s.
        feedforward: N*m*s/rad.
        integral_time: s.
        period, late: sampling period of the servo and computing delay of its effort, s.
        phase: when the first sample is taken, in periods.
    """
    stamps, values = commands()
    values = values * (1.0 if servo == "position" else 4.0)
    # Python's own floats: numbers of NumPy take five times as long one by one.
    command, end = values.tolist(), float(stamps[-1])
    h = 4e-5
    q, v, seen, out = 0.0, 0.0, 0.0, []
    s, gain = command[0], KP if servo == "position" else KV
    kept = 0.0
    due: list[tuple[float, float]] = []
    held, ticks, read = 0.0, 0, 0.0
    for k in range(round(end / h) + 1):
        t = k * h
        if k % 250 == 0:
            out.append(q)
        at = min(int(t / 0.01 + 1e-9), len(command) - 1)
        before, s = s, float(np.interp(t, stamps, values)) if moving else command[at]
        rate = (s - before) / h
        seen += h / filtered * (v - seen) if filtered else v - seen
        if period and t >= (ticks + phase) * period - 1e-12:
            speed = (q - read) / period
            asked = KP * (s - q) - KV * speed if servo == "position" else KV * (s - speed)
            due.append((t + late, asked))
            read, ticks = q, ticks + 1
        while due and due[0][0] <= t + 1e-12:
            held = due.pop(0)[1]
        if period:
            asked = held
        else:
            error = s - (q if servo == "position" else v)
            asked = gain * (error + kept) - (KV * seen if servo == "position" else 0.0)
            asked += feedforward * rate
            if abs(asked) <= LIMIT or asked * error < 0.0:
                kept += h * error / integral_time
        torque = min(max(asked, -LIMIT), LIMIT)
        v += h * (torque - WEIGHT * math.sin(q)) / INERTIA
        q += h * v
    return np.array(out)


@functools.cache
def plain(servo: str = "position") -> np.ndarray:
    """Positions of the servo without an effect."""
    return reference(servo=servo)


def test_the_reference_integration_agrees_with_mujoco() -> None:
    assert np.abs(positions("", {}) - plain()).max() < 2e-3


@pytest.mark.parametrize("lag", [0.005, 0.02])
def test_the_derivative_term_acts_on_the_filtered_velocity(lag: float) -> None:
    found = positions("velocity_filter", {"time_constant": lag})
    wanted = reference(filtered=lag)
    effect = np.abs(wanted - plain()).max()
    assert np.abs(found - wanted).max() < max(0.03 * effect, 1.5e-3)


def test_a_feedforward_adds_the_rate_of_the_setpoint() -> None:
    found = positions("velocity_feedforward", {"feedforward": 0.2}, moving=True)
    wanted = reference(feedforward=0.2, moving=True)
    effect = np.abs(wanted - reference(moving=True)).max()
    assert effect > 0.03
    assert np.abs(found - wanted).max() < 0.05 * effect


@pytest.mark.parametrize("servo", ["position", "velocity"])
@pytest.mark.parametrize("integral_time", [0.3, 1.5])
def test_the_integral_term_accumulates_as_in_the_reference(
    servo: str, integral_time: float
) -> None:
    found = positions("integral_gain", {"inverse_integral_time": 1.0 / integral_time}, servo)
    wanted = reference(integral_time=integral_time, servo=servo)
    effect = np.abs(wanted - plain(servo)).max()
    assert effect > 0.01
    assert np.abs(found - wanted).max() < max(0.03 * effect, 2e-3)


def test_the_integral_term_starts_in_static_equilibrium() -> None:
    held = positions("integral_gain", {"inverse_integral_time": 0.5}, start=0.0)
    assert abs(held[1]) < 1e-3
    raised = positions("integral_gain", {"inverse_integral_time": 1e-3}, start=0.3)
    dropped = positions("", {}, start=0.3)
    # The command is 0: the integral term holds the link at 0.3 rad until the command changes.
    assert abs(raised[3] - 0.3) < 0.02 < 0.05 < abs(dropped[3] - 0.3)


def reference_phase_average(period: float, late: float, servo: str = "position") -> FloatArray:
    """(samples,) position, rad, with the servo effort averaged over all sampling phases."""
    stamps, command = commands()
    command = command * (1.0 if servo == "position" else 4.0)
    h, q, v, out = 4e-5, 0.0, 0.0, []
    steps, wait = round(period / h), round(late / h)
    before = 2 * steps + wait + 1
    count = before + round(stamps[-1] / h) + 1
    readings, setpoints = np.zeros(count), np.zeros(count)
    for k in range(before, count):
        t = (k - before) * h
        if (k - before) % 250 == 0:
            out.append(q)
        readings[k], setpoints[k] = q, command[min(int(t / 0.01 + 1e-9), len(command) - 1)]
        used = slice(k - wait - steps + 1, k - wait + 1)
        earlier = readings[used.start - steps : used.stop - steps]
        reading, speed = readings[used].mean(), (readings[used] - earlier).mean() / period
        s = setpoints[used].mean()
        asked = KP * (s - reading) - KV * speed if servo == "position" else KV * (s - speed)
        v += h * (np.clip(asked, -LIMIT, LIMIT) - WEIGHT * np.sin(q)) / INERTIA
        q += h * v
    return np.array(out)


@pytest.mark.parametrize(
    ("period", "delay", "servo"),
    [
        (0.005, 0.0, "position"),
        (0.005, 1.0, "position"),
        (0.012, 0.4, "position"),
        (0.008, 1.0, "velocity"),
    ],
)
def test_control_period_acts_with_the_mean_over_sampling_phases(
    period: float, delay: float, servo: str
) -> None:
    found = positions("control_period", {"period": period, "computing_delay": delay}, servo)
    wanted = reference_phase_average(period, delay * period, servo)
    effect = np.abs(wanted - plain(servo)).max()
    assert effect > 0.005
    assert np.abs(found - wanted).max() < max(0.05 * effect, 2e-3)


@pytest.mark.parametrize(("period", "delay"), [(0.006, 1.0), (0.0123, 0.0)])
def test_control_period_predicts_the_mean_motion_over_sampling_phases(
    period: float, delay: float
) -> None:
    found = positions("control_period", {"period": period, "computing_delay": delay})
    phases = (np.arange(4) + 0.5) / 4.0
    each = np.array([reference(period=period, late=delay * period, phase=x) for x in phases])
    rms = np.sqrt(np.mean((found - each.mean(axis=0)) ** 2))
    assert rms < 0.15 * np.sqrt(np.mean((plain() - each.mean(axis=0)) ** 2))
    # The error is smaller than the difference between two sampling phases.
    assert rms < np.sqrt(np.mean((each[0] - each[2]) ** 2))


def test_the_motion_changes_smoothly_as_control_period_crosses_the_time_step() -> None:
    """Periods below the time step are averaged."""
    periods = np.linspace(0.0012, 0.0028, 5)
    each = [
        positions("control_period", {"period": p, "computing_delay": 0.5}, refine=1)
        for p in periods
    ]
    changes = np.sqrt(np.mean(np.diff(np.array(each), axis=0) ** 2, axis=1))
    assert changes.max() < 2.5 * changes.min()


@pytest.mark.parametrize(
    ("effect", "small"),
    [
        ("control_period", {"period": 1e-6, "computing_delay": 1.0}),
        ("velocity_filter", {"time_constant": 1e-7}),
        ("velocity_feedforward", {"feedforward": 1e-7}),
    ],
)
def test_servo_effects_near_neutral_values_change_the_motion_little(
    effect: str, small: dict[str, float]
) -> None:
    assert np.abs(positions(effect, small, refine=1) - positions("", {}, refine=1)).max() < 2e-3


def test_the_control_range_does_not_limit_the_effort_of_a_servo_effect() -> None:
    """The control range limits the command, not the setpoint shift that represents the effect."""
    limits = f'ctrllimited="true" ctrlrange="-{RANGE} {RANGE}"'
    free = positions("velocity_filter", {"time_constant": 0.02}, attributes="")
    bounded = positions("velocity_filter", {"time_constant": 0.02}, attributes=limits)
    assert np.array_equal(free, bounded)


def test_servo_effect_parameters_have_units_for_hinges_and_slides() -> None:
    for name in ("control_period", "velocity_filter", "integral_gain"):
        assert {p.unit("slide") for p in catalogue()[name].parameters} <= {"s", "1"}
    (gain,) = catalogue()["velocity_feedforward"].parameters
    assert (gain.unit("hinge"), gain.unit("slide")) == ("N*m*s/rad", "N*s/m")


def test_commands_are_limited_to_the_control_range_before_the_servo_law() -> None:
    """With or without a servo effect: MuJoCo applies the limit, or the effect code does."""
    limits = 'ctrllimited="true" ctrlrange="-0.2 0.2"'
    plain = positions("", {}, attributes=limits, refine=1)
    shifted = positions("velocity_filter", {"time_constant": 1e-7}, attributes=limits, refine=1)
    assert np.abs(plain - positions("", {}, refine=1)).max() > 0.1
    assert np.abs(plain - shifted).max() < 1e-3
