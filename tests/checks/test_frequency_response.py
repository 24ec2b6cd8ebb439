"""Frequency responses compared with transfer functions, and their failure on changed models."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bench_models import (
    MASS,
    MOTOR,
    failed,
    golden_of,
    load_text,
    measures_on,
    observe,
    recorded,
    servo,
    slider,
)

from pytest_twin.checks.frequency_response import FrequencyResponse
from pytest_twin.errors import SimulationError, SpecError

CHECK = FrequencyResponse()
STIFFNESS, DAMPING, STEP = 800.0, 20.0, 0.002
SPEC = {
    "target": {"joint": "x"},
    "stimulus": {
        "amplitude": "10 mm",
        "band": ["0.5 Hz", "20 Hz"],
        "period": "2 s",
        "settle": "0 s",
        "transient_periods": 2,
    },
    "tolerance": {
        "magnitude": "0.05 dB",
        "phase": "0.5 deg",
        "coherence": "0.01",
        "bandwidth": "0.05 Hz",
        "resonance": "0.05 Hz",
        "resonance_peak": "0.1 dB",
    },
}


def servo_on_slider(timestep: float = STEP, **more: object) -> str:
    arguments = {"actuator": servo(STIFFNESS, DAMPING), "timestep": timestep} | more
    return slider(**arguments)  # type: ignore[arg-type]


def discrete_response(frequency: np.ndarray, timestep: float) -> np.ndarray:
    """Discrete transfer function from command to position of a servo on a mass in MuJoCo.

    One implicitfast step with the command held: v' = v + h (kp (u - x) - kv v) / (m + h kv) and
    x' = x + h v'.
    """
    gain = timestep / (MASS + timestep * DAMPING)
    velocity = np.array([-gain * STIFFNESS, 1.0 - gain * DAMPING])
    a = np.array([[1.0, 0.0] + timestep * velocity, velocity])
    b = np.array([timestep * gain * STIFFNESS, gain * STIFFNESS])
    z = np.exp(2j * np.pi * frequency * timestep)
    return np.array([np.linalg.solve(value * np.eye(2) - a, b)[0] for value in z])


def continuous_response(frequency: np.ndarray) -> np.ndarray:
    s = 2j * np.pi * frequency
    return STIFFNESS / (MASS * s**2 + DAMPING * s + STIFFNESS)


@pytest.mark.parametrize("signal", ["multisine", "chirp"])
def test_the_response_of_a_servo_equals_its_discrete_transfer_function(
    tmp_path: Path, signal: str
) -> None:
    robot = load_text(tmp_path, servo_on_slider())
    spec = {**SPEC, "stimulus": {**SPEC["stimulus"], "signal": signal}}
    found = observe(CHECK, golden_of(CHECK, spec), robot)
    assert found.values["lines_carried"] == found.values["lines_excited"]
    assert found.trace is not None
    columns = {name: series for name, (_, series) in found.trace.columns.items()}
    exact = discrete_response(found.trace.x, STEP)
    np.testing.assert_allclose(columns["magnitude"], np.abs(exact), rtol=1e-5)
    np.testing.assert_allclose(columns["phase"], np.unwrap(np.angle(exact)), atol=1e-5)
    np.testing.assert_allclose(columns["coherence"], 1.0, atol=1e-9)


def test_the_phase_lag_by_the_timestep_is_below_half_a_step(tmp_path: Path) -> None:
    for timestep in (0.002, 0.0005):
        robot = load_text(tmp_path, servo_on_slider(timestep), f"{timestep}.xml")
        found = observe(CHECK, golden_of(CHECK, SPEC), robot)
        assert found.trace is not None
        frequency = found.trace.x
        exact = continuous_response(frequency)
        lag = np.unwrap(np.angle(exact)) - found.trace.columns["phase"][1]
        held = np.pi * frequency * timestep
        # The semi-implicit integrator compensates part of the half-step delay of the hold.
        assert lag.min() > 0.0
        assert (lag / held).max() < 1.0
        assert (lag / held).max() > 0.5
        assert found.values["resonance"] == pytest.approx(
            np.sqrt(STIFFNESS / MASS - 0.5 * (DAMPING / MASS) ** 2) / (2.0 * np.pi), rel=0.04
        )  # the frequency resolution is 0.5 Hz
        dense = np.linspace(0.5, 20.0, 100_001)
        level = np.abs(continuous_response(dense)) / np.abs(continuous_response(np.array([0.5])))
        half_power = dense[np.argmax(level < np.sqrt(0.5))]
        assert found.values["bandwidth"] == pytest.approx(half_power, rel=0.02)


def test_the_response_of_a_motor_is_velocity_per_effort(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(damping=30.0, actuator=MOTOR, timestep=0.0005))
    spec = {**SPEC, "stimulus": {**SPEC["stimulus"], "amplitude": "5 N"}}
    found = observe(CHECK, golden_of(CHECK, spec), robot)
    assert found.trace is not None
    unit, magnitude = found.trace.columns["magnitude"]
    assert unit == "(m/s)/(N)"
    exact = 1.0 / (30.0 + 2j * np.pi * found.trace.x * MASS)
    np.testing.assert_allclose(magnitude, np.abs(exact), rtol=5e-3)
    assert found.values["bandwidth"] == pytest.approx(
        30.0 / MASS / (2.0 * np.pi) * np.sqrt(1.0 + 2.0 * (0.5 * 2.0 * np.pi * MASS / 30.0) ** 2),
        rel=0.03,
    )
    assert found.values["resonance"] is None


def test_the_response_of_a_joint_without_actuator_is_that_of_a_mass(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(timestep=STEP))
    spec = {**SPEC, "stimulus": {**SPEC["stimulus"], "amplitude": "5 N"}}
    found = observe(CHECK, golden_of(CHECK, spec), robot)
    assert found.trace is not None
    exact = 1.0 / (2.0 * np.pi * found.trace.x * MASS)
    np.testing.assert_allclose(found.trace.columns["magnitude"][1], exact, rtol=5e-3)
    assert found.values["bandwidth"] is None


def test_frequencies_with_low_coherence_by_dry_friction_are_not_reported(tmp_path: Path) -> None:
    robot = load_text(tmp_path, servo_on_slider(friction=1.0))
    small = {**SPEC["stimulus"], "amplitude": "3 mm"}
    every = observe(
        CHECK, golden_of(CHECK, {**SPEC, "stimulus": {**small, "coherence": 1e-6}}), robot
    )
    assert every.trace is not None
    coherence = every.trace.columns["coherence"][1]
    assert coherence.min() < 0.95
    kept = observe(
        CHECK, golden_of(CHECK, {**SPEC, "stimulus": {**small, "coherence": 0.95}}), robot
    )
    assert kept.trace is not None
    np.testing.assert_array_equal(kept.trace.x, every.trace.x[coherence >= 0.95])
    assert kept.values["lines_carried"] == kept.trace.x.size < kept.values["lines_excited"]


def test_no_frequency_with_sufficient_coherence_is_an_error(tmp_path: Path) -> None:
    robot = load_text(tmp_path, servo_on_slider(friction=2.0))
    strict = {**SPEC, "stimulus": {**SPEC["stimulus"], "coherence": 1}}
    with pytest.raises(SpecError, match=r"no line of \d+ reaches the required coherence: highest"):
        observe(CHECK, golden_of(CHECK, strict), robot)


@pytest.mark.parametrize(
    ("change", "caught"),
    [
        ({}, set()),
        ({"actuator": servo(STIFFNESS, 1.2 * DAMPING)}, {"magnitude", "resonance_peak"}),
        ({"actuator": servo(0.8 * STIFFNESS, DAMPING)}, {"bandwidth", "resonance", "magnitude"}),
        ({"timestep": 2.5 * STEP}, {"phase"}),
        ({"friction": 0.5}, {"magnitude"}),
        ({"actuator": servo(STIFFNESS, DAMPING, 'delay="0.01" nsample="6"')}, {"phase"}),
    ],
)
def test_changed_dynamics_fail_the_expected_response_measures(
    tmp_path: Path, change: dict, caught: set[str]
) -> None:
    golden, trace = recorded(CHECK, SPEC, load_text(tmp_path, servo_on_slider()))
    changed = load_text(tmp_path, servo_on_slider(**change), "changed.xml")
    found = failed(measures_on(CHECK, golden, trace, changed))
    assert caught <= found
    assert bool(found) == bool(change)


def test_a_frequency_that_lost_its_coherence_fails_with_the_reason(tmp_path: Path) -> None:
    wide = {**SPEC, "tolerance": {"magnitude": "1000 dB"}}
    golden, trace = recorded(CHECK, wide, load_text(tmp_path, servo_on_slider()))
    rough = load_text(tmp_path, servo_on_slider(friction=2.0), "rough.xml")
    measure = measures_on(CHECK, golden, trace, rough)["magnitude"]
    assert not measure.passed
    assert "not carried now" in measure.subject


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("band", ["0.5 Hz", "400 Hz"], "the band does not fit the period and the timestep"),
        ("band", ["20 Hz", "0.5 Hz"], "the band does not fit the period and the timestep"),
        ("band", ["0.1 Hz", "0.4 Hz"], "the band does not fit the period and the timestep"),
        ("amplitude", "0 m", "the amplitude is not above zero"),
        ("amplitude", "2 m", "the stimulus exceeds the control's range"),
        ("period", "1000 s", "out of bounds"),
        ("period", "0 s", "out of bounds"),
    ],
)
def test_invalid_frequency_response_specs_are_refused_with_their_line(
    tmp_path: Path, field: str, value: object, words: str
) -> None:
    actuator = servo(STIFFNESS, DAMPING, 'ctrlrange="-1 1"')
    robot = load_text(tmp_path, servo_on_slider(actuator=actuator))
    golden = golden_of(CHECK, {**SPEC, "stimulus": {**SPEC["stimulus"], field: value}})
    with pytest.raises(SpecError) as caught:
        observe(CHECK, golden, robot)
    assert words in str(caught.value)
    assert caught.value.line == golden.lines[f"stimulus.{field}"]


def test_a_diverging_model_is_reported_with_time_and_joint(tmp_path: Path) -> None:
    text = slider(actuator=servo(1e7, 0.0), integrator="Euler", timestep=0.005)
    with pytest.raises(SimulationError, match=r"joint 'x': the simulation diverged at [0-9.]+ s"):
        observe(CHECK, golden_of(CHECK, SPEC), load_text(tmp_path, text))


def test_repeated_frequency_responses_are_identical(tmp_path: Path) -> None:
    robot = load_text(tmp_path, servo_on_slider(friction=0.5))
    first, second = (observe(CHECK, golden_of(CHECK, SPEC), robot) for _ in range(2))
    assert first.values == second.values
    assert first.trace is not None
    assert second.trace is not None
    for name, (_, series) in first.trace.columns.items():
        np.testing.assert_array_equal(series, second.trace.columns[name][1])


@pytest.mark.parametrize("actuator", [servo(STIFFNESS, DAMPING), MOTOR, ""])
def test_proposed_frequency_response_goldens_pass(tmp_path: Path, actuator: str) -> None:
    robot = load_text(tmp_path, slider(actuator=actuator, timestep=STEP))
    specs = CHECK.first(robot)
    assert [spec["name"] for spec in specs] == ["x"]
    golden, trace = recorded(CHECK, specs[0], robot)
    measures = measures_on(CHECK, golden, trace, robot)
    assert {"magnitude", "phase"} <= set(measures)
    assert failed(measures) == set()
