"""Servo effects compared with an independent integration of a pendulum on a digital servo."""

from __future__ import annotations

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
    """A swing and two steps, held for 10 ms."""
    stamps: FloatArray = 0.01 * np.arange(round(SECONDS / 0.01), dtype=np.float64)
    swing = 0.5 * np.sin(2.0 * np.pi * 1.7 * stamps)
    return stamps, swing * (stamps < 0.8) + 0.4 * (stamps > 0.9) - 0.6 * (stamps > 1.2)


def moved(
    effect: str, values: dict[str, float], servo: str = "position", refine: int = FINE,
    attributes: str = "", start: float = 0.0, moving: bool = False,
) -> FloatArray:  # fmt: skip
    """Positions every 10 ms under an effect; without one if its values are empty."""
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


def expected(
    *, filtered: float = 0.0, feedforward: float = 0.0, integral_time: float = np.inf,
    period: float = 0.0, late: float = 0.0, phase: float = 0.0, servo: str = "position",
    moving: bool = False,
) -> FloatArray:  # fmt: skip
    """The same by semi-implicit Euler at 40 us; no part of the package.

    Args:
        filtered: time constant of the velocity filter, s.
        feedforward: N*m*s/rad.
        integral_time: s.
        period, late: of the servo's samples, and the delay of their effort, s.
        phase: when the first sample is taken, in periods.
    """
    stamps, command = commands()
    command = command * (1.0 if servo == "position" else 4.0)
    h = 4e-5
    q, v, seen, out = 0.0, 0.0, 0.0, []
    s, gain = command[0], KP if servo == "position" else KV
    kept = 0.0
    due: list[tuple[float, float]] = []
    held, ticks, read = 0.0, 0, 0.0
    for k in range(round(stamps[-1] / h) + 1):
        t = k * h
        if k % 250 == 0:
            out.append(q)
        at = min(int(t / 0.01 + 1e-9), len(command) - 1)
        before, s = s, float(np.interp(t, stamps, command)) if moving else command[at]
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
        torque = np.clip(asked, -LIMIT, LIMIT)
        v += h * (torque - WEIGHT * np.sin(q)) / INERTIA
        q += h * v
    return np.array(out)


PLAIN = {servo: expected(servo=servo) for servo in ("position", "velocity")}


def test_the_integration_here_is_that_of_the_engine() -> None:
    assert np.abs(moved("", {}) - PLAIN["position"]).max() < 2e-3


@pytest.mark.parametrize("lag", [0.005, 0.02])
def test_the_derivative_term_acts_on_the_filtered_velocity(lag: float) -> None:
    found = moved("velocity_filter", {"time_constant": lag})
    wanted = expected(filtered=lag)
    effect = np.abs(wanted - PLAIN["position"]).max()
    assert np.abs(found - wanted).max() < max(0.03 * effect, 1.5e-3)


def test_a_feedforward_adds_the_rate_of_the_setpoint() -> None:
    found = moved("velocity_feedforward", {"feedforward": 0.2}, moving=True)
    wanted = expected(feedforward=0.2, moving=True)
    effect = np.abs(wanted - expected(moving=True)).max()
    assert effect > 0.03
    assert np.abs(found - wanted).max() < 0.05 * effect


@pytest.mark.parametrize("servo", ["position", "velocity"])
@pytest.mark.parametrize("integral_time", [0.3, 1.5])
def test_the_integral_term_takes_the_load_over(servo: str, integral_time: float) -> None:
    found = moved("integral_gain", {"inverse_integral_time": 1.0 / integral_time}, servo)
    wanted = expected(integral_time=integral_time, servo=servo)
    effect = np.abs(wanted - PLAIN[servo]).max()
    assert effect > 0.01
    assert np.abs(found - wanted).max() < max(0.03 * effect, 2e-3)


def test_the_integral_term_carries_the_load_from_the_first_step() -> None:
    held = moved("integral_gain", {"inverse_integral_time": 0.5}, start=0.0)
    assert abs(held[1]) < 1e-3
    raised = moved("integral_gain", {"inverse_integral_time": 1e-3}, start=0.3)
    dropped = moved("", {}, start=0.3)
    # The command is 0: the term holds what the servo does not, until the command moves.
    assert abs(raised[3] - 0.3) < 0.02 < 0.05 < abs(dropped[3] - 0.3)


def averaged(period: float, late: float, servo: str = "position") -> FloatArray:
    """The mean over all phases of the sample in use, integrated as above."""
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
def test_a_sampled_servo_acts_on_the_mean_over_the_phases(
    period: float, delay: float, servo: str
) -> None:
    found = moved("control_period", {"period": period, "computing_delay": delay}, servo)
    wanted = averaged(period, delay * period, servo)
    effect = np.abs(wanted - PLAIN[servo]).max()
    assert effect > 0.005
    assert np.abs(found - wanted).max() < max(0.05 * effect, 2e-3)


@pytest.mark.parametrize(("period", "delay"), [(0.006, 1.0), (0.0123, 0.0)])
def test_servos_that_sample_at_any_phase_move_alike_on_average(period: float, delay: float) -> None:
    found = moved("control_period", {"period": period, "computing_delay": delay})
    phases = (np.arange(4) + 0.5) / 4.0
    each = np.array([expected(period=period, late=delay * period, phase=x) for x in phases])
    rms = np.sqrt(np.mean((found - each.mean(axis=0)) ** 2))
    assert rms < 0.15 * np.sqrt(np.mean((PLAIN["position"] - each.mean(axis=0)) ** 2))
    # Less than a servo of one phase differs from one of another.
    assert rms < np.sqrt(np.mean((each[0] - each[2]) ** 2))


def test_periods_about_the_step_are_no_threshold() -> None:
    """Periods below the step are averaged. The motion follows them on both sides."""
    periods = np.linspace(0.0012, 0.0028, 5)
    each = np.array([
        moved("control_period", {"period": p, "computing_delay": 0.5}, refine=1) for p in periods
    ])  # fmt: skip
    apart = np.sqrt(np.mean(np.diff(each, axis=0) ** 2, axis=1))
    assert apart.max() < 2.5 * apart.min()


@pytest.mark.parametrize(
    ("effect", "small"),
    [
        ("control_period", {"period": 1e-6, "computing_delay": 1.0}),
        ("velocity_filter", {"time_constant": 1e-7}),
        ("velocity_feedforward", {"feedforward": 1e-7}),
    ],
)
def test_a_small_effect_changes_little(effect: str, small: dict[str, float]) -> None:
    assert np.abs(moved(effect, small, refine=1) - moved("", {}, refine=1)).max() < 2e-3


def test_a_servo_may_ask_for_more_than_its_command_range() -> None:
    """The range of commands bounds what is commanded, not the shift of the setpoint."""
    limits = f'ctrllimited="true" ctrlrange="-{RANGE} {RANGE}"'
    free = moved("velocity_filter", {"time_constant": 0.02}, attributes="")
    bounded = moved("velocity_filter", {"time_constant": 0.02}, attributes=limits)
    assert np.array_equal(free, bounded)


def test_units_are_those_of_a_slide_too() -> None:
    for name in ("control_period", "velocity_filter", "integral_gain"):
        assert {p.unit("slide") for p in catalogue()[name].parameters} <= {"s", "1"}
    (gain,) = catalogue()["velocity_feedforward"].parameters
    assert (gain.unit("hinge"), gain.unit("slide")) == ("N*m*s/rad", "N*s/m")


def test_a_command_beyond_the_range_of_the_drive_is_bounded_before_the_servo() -> None:
    """With a servo effect as without: the engine bounds it, or the laws between its steps do."""
    limits = 'ctrllimited="true" ctrlrange="-0.2 0.2"'
    plain = moved("", {}, attributes=limits, refine=1)
    shifted = moved("velocity_filter", {"time_constant": 1e-7}, attributes=limits, refine=1)
    assert np.abs(plain - moved("", {}, refine=1)).max() > 0.1
    assert np.abs(plain - shifted).max() < 1e-3
