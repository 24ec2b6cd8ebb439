"""Step responses compared with closed forms, and their failure on changed models."""

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

from pytest_twin.checks.step import SAMPLES, Step
from pytest_twin.errors import SimulationError, SpecError
from pytest_twin.realization import simulate

CHECK = Step()
STIFFNESS, DAMPING = 800.0, 30.0
STEP = {
    "target": {"joint": "x"},
    "stimulus": {"amplitude": "20 mm", "duration": "1.5 s", "settle": "0 s"},
    "tolerance": {
        "rise_time": "1 ms",
        "overshoot": "0.5 %",
        "settling_time": "5 ms",
        "steady_state_error": "0.1 %",
        "position": "20 um",
    },
}
VELOCITY_STEP = {
    "target": {"joint": "x"},
    "stimulus": {"amplitude": "0.5 m/s", "duration": "1 s", "settle": "0 s"},
    "tolerance": {"rise_time": "1 ms", "linear_velocity": "1 mm/s", "steady_state_error": "0.1 %"},
}


def closed_form(time: np.ndarray) -> np.ndarray:
    """Unit step response of a mass on a damped spring."""
    decay = DAMPING / (2.0 * MASS)
    omega = np.sqrt(STIFFNESS / MASS - decay**2)
    return 1.0 - np.exp(-decay * time) * (
        np.cos(omega * time) + decay / omega * np.sin(omega * time)
    )


@pytest.mark.parametrize(("integrator", "floor"), [("RK4", 1e-9), ("implicitfast", 2e-4)])
def test_the_step_response_of_a_position_servo_is_second_order(
    tmp_path: Path, integrator: str, floor: float
) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING), integrator=integrator))
    found = observe(CHECK, golden_of(CHECK, STEP), robot)
    zeta = DAMPING / (2.0 * np.sqrt(STIFFNESS * MASS))
    overshoot = np.exp(-np.pi * zeta / np.sqrt(1.0 - zeta**2))
    assert found.values["overshoot"] == pytest.approx(overshoot, abs=0.003)
    assert found.values["final"] == pytest.approx(0.02, abs=1e-6)
    assert found.values["steady_state_error"] == pytest.approx(0.0, abs=1e-4)
    dense = np.linspace(0.0, 1.5, 1_500_001)
    exact = closed_form(dense)
    rise = dense[np.argmax(exact >= 0.9)] - dense[np.argmax(exact >= 0.1)]
    settled = dense[np.flatnonzero(np.abs(exact - 1.0) > 0.02)[-1]]
    assert found.values["rise_time"] == pytest.approx(rise, abs=2e-4)
    assert found.values["settling_time"] == pytest.approx(settled, abs=2e-3)
    assert found.trace is not None
    assert found.trace.x.size == SAMPLES
    unit, series = found.trace.columns["position:x"]
    assert unit == "m"
    # Linear interpolation between steps of 0.5 ms adds at most (h^2 / 8) max |x''|.
    between = 0.0005**2 / 8.0 * STIFFNESS / MASS * 0.02
    np.testing.assert_allclose(series, 0.02 * closed_form(found.trace.x), atol=floor + between)


def test_the_step_response_of_a_velocity_servo_is_first_order(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator='<velocity name="v" joint="x" kv="40"/>'))
    found = observe(CHECK, golden_of(CHECK, VELOCITY_STEP), robot).values
    tau = MASS / 40.0
    assert found["rise_time"] == pytest.approx(np.log(9.0) * tau, rel=0.01)
    assert found["settling_time"] == pytest.approx(np.log(50.0) * tau, rel=0.01)
    assert found["overshoot"] == pytest.approx(0.0, abs=1e-6)
    assert found["steady_state_error"] == pytest.approx(0.0, abs=1e-6)


def test_a_motor_on_a_damped_joint_has_no_steady_state_error(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(damping=40.0, actuator=MOTOR))
    spec = {**VELOCITY_STEP, "stimulus": {**VELOCITY_STEP["stimulus"], "amplitude": "20 N"}}
    found = observe(CHECK, golden_of(CHECK, spec), robot).values
    assert found["final"] == pytest.approx(20.0 / 40.0, rel=1e-6)
    assert found["rise_time"] == pytest.approx(np.log(9.0) * MASS / 40.0, rel=0.01)
    assert found["steady_state_error"] is None


def test_an_effort_step_accelerates_a_joint_without_actuator(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider())
    spec = {**VELOCITY_STEP, "stimulus": {**VELOCITY_STEP["stimulus"], "amplitude": "3 N"}}
    found = observe(CHECK, golden_of(CHECK, spec), robot)
    assert found.trace is not None
    np.testing.assert_allclose(
        found.trace.columns["velocity:x"][1], 3.0 / MASS * found.trace.x, atol=1e-9
    )
    assert found.values["rise_time"] is None  # the velocity is a ramp


def test_locked_joints_do_not_change_the_inertia_of_the_moving_joint(tmp_path: Path) -> None:
    text = """
    <mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody>
      <body><joint name="base" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
        <body><joint name="x" type="slide" axis="1 0 0" damping="5"/>
          <geom size=".1" mass="2"/></body></body>
    </worldbody><actuator><motor name="m" joint="x"/></actuator></mujoco>"""
    robot = load_text(tmp_path, text)
    stimulus = {"amplitude": "3 N", "duration": "1 s", "contact": False, "settle": "0 s"}
    finals = {}
    for others in ("free", "locked"):
        spec = {"target": {"joint": "x"}, "stimulus": {**stimulus, "others": others}}
        trace = observe(CHECK, golden_of(CHECK, spec), robot).trace
        assert trace is not None
        finals[others] = trace.columns["velocity:x"][1]
        time = trace.x
    mass = {"free": 1.0 * 2.0 / 3.0, "locked": 2.0}  # reduced mass of two free bodies
    for others, series in finals.items():
        exact = 3.0 / 5.0 * (1.0 - np.exp(-5.0 * time / mass[others]))
        np.testing.assert_allclose(series, exact, atol=2e-3)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_a_locked_joint_does_not_move_under_gravity(tmp_path: Path, integrator: str) -> None:
    text = f"""
    <mujoco><option timestep="0.002" integrator="{integrator}"/><worldbody>
      <body><joint name="lift" axis="0 1 0"/><geom size=".05" pos=".5 0 0" mass="8"/>
        <body pos=".8 0 0"><joint name="x" type="slide" axis="0 1 0" damping="0.5"/>
          <geom size=".01" mass="0.02"/></body></body>
    </worldbody></mujoco>"""
    robot = load_text(tmp_path, text)
    model = simulate.prepare_model(robot, locked=["lift"])
    data = simulate.initial_state(model, robot, robot.model.qpos0)
    data.qfrc_applied[1] = 0.05
    run = simulate.simulate(model, data, simulate.steps_in(model, 2.0))
    sagged = np.abs(run.qpos[:, 0]).max()
    assert sagged < (2e-3 if integrator == "RK4" else 1e-6)
    exact = 0.05 / 0.5 * (1.0 - np.exp(-0.5 / 0.02 * run.time))
    np.testing.assert_allclose(run.qvel[:, 1], exact, atol=2e-3)


@pytest.mark.parametrize(
    ("change", "caught"),
    [
        ({}, set()),
        ({"actuator": servo(STIFFNESS, 1.2 * DAMPING)}, {"overshoot", "position"}),
        ({"friction": 1.0}, {"position", "steady_state_error"}),
        ({"timestep": 0.005}, {"position"}),
        ({"actuator": servo(STIFFNESS, DAMPING, 'forcerange="-5 5"')}, {"rise_time", "position"}),
        ({"actuator": servo(STIFFNESS, DAMPING, 'delay="0.01" nsample="21"')}, {"position"}),
        ({"joint": 'armature="0.2"'}, {"rise_time", "position"}),
    ],
)
def test_changed_dynamics_fail_the_expected_step_measures(
    tmp_path: Path, change: dict, caught: set[str]
) -> None:
    plain = {"actuator": servo(STIFFNESS, DAMPING)}
    golden, trace = recorded(CHECK, STEP, load_text(tmp_path, slider(**plain)))
    changed = load_text(tmp_path, slider(**plain | change), "changed.xml")
    found = failed(measures_on(CHECK, golden, trace, changed))
    assert caught <= found
    assert bool(found) == bool(change)


def test_a_failed_trace_states_the_time_of_the_worst_sample(tmp_path: Path) -> None:
    golden, trace = recorded(
        CHECK, STEP, load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    )
    changed = load_text(tmp_path, slider(actuator=servo(STIFFNESS, 1.2 * DAMPING)), "b.xml")
    measure = measures_on(CHECK, golden, trace, changed)["position"]
    assert measure.subject == "x"
    assert measure.time is not None
    assert 0.0 < measure.time < 0.5
    assert measure.error == pytest.approx(abs(measure.measured - measure.golden))


def test_a_metric_that_is_undefined_in_one_of_both_runs_fails(tmp_path: Path) -> None:
    still = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    rings = load_text(tmp_path, slider(actuator=servo(STIFFNESS, 0.0)), "rings.xml")
    golden, trace = recorded(CHECK, STEP, still)
    now = measures_on(CHECK, golden, trace, rings)["rise_time"]
    assert not now.passed
    assert now.subject == "x: undefined now (the response does not reach a steady state)"
    golden, trace = recorded(CHECK, STEP, rings)
    then = measures_on(CHECK, golden, trace, still)["rise_time"]
    assert not then.passed
    assert then.subject.startswith("x: undefined in the golden")
    assert "rise_time" not in measures_on(CHECK, golden, trace, rings)


@pytest.mark.parametrize(
    ("part", "field", "value", "words"),
    [
        ("target", "joint", "y", "target.joint: no hinge or slide joint of this name"),
        ("target", "command", "velocity", "target.command: no actuator takes velocity commands"),
        ("stimulus", "amplitude", "2 m", "the stimulus exceeds the control's range"),
        ("stimulus", "amplitude", "0 m", "the amplitude is zero"),
        ("stimulus", "amplitude", "1 rad", "unit 'rad' does not fit"),
        ("stimulus", "duration", "0 s", "out of bounds"),
        ("stimulus", "settle", "-1 s", "out of bounds"),
        ("stimulus", "pose", "home", "no pose or keyframe of this name"),
        ("tolerance", "angle", "1 mrad", "joint 'x' responds in m"),
    ],
)
def test_invalid_step_specs_are_refused_with_their_line(
    tmp_path: Path, part: str, field: str, value: object, words: str
) -> None:
    actuator = servo(STIFFNESS, DAMPING, 'ctrlrange="-1 1"')
    robot = load_text(tmp_path, slider(actuator=actuator))
    golden = golden_of(CHECK, {**STEP, part: {**STEP[part], field: value}})
    with pytest.raises(SpecError) as caught:
        observe(CHECK, golden, robot)
    assert words in str(caught.value)
    assert caught.value.line == golden.lines[f"{part}.{field}"]


def test_a_diverging_model_is_reported_with_time_and_joint(tmp_path: Path) -> None:
    text = slider(actuator=servo(1e9, 0.0), integrator="Euler", timestep=0.01)
    with pytest.raises(SimulationError, match=r"joint 'x': the simulation diverged at [0-9.]+ s"):
        observe(CHECK, golden_of(CHECK, STEP), load_text(tmp_path, text))


def test_repeated_step_responses_are_identical(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    first, second = (observe(CHECK, golden_of(CHECK, STEP), robot) for _ in range(2))
    assert first.values == second.values
    assert first.trace is not None
    assert second.trace is not None
    np.testing.assert_array_equal(
        first.trace.columns["position:x"][1], second.trace.columns["position:x"][1]
    )


@pytest.mark.parametrize("actuator", [servo(STIFFNESS, DAMPING), MOTOR, ""])
def test_proposed_step_goldens_pass(tmp_path: Path, actuator: str) -> None:
    robot = load_text(tmp_path, slider(actuator=actuator, joint='range="-0.4 0.4"'))
    specs = CHECK.first(robot)
    assert [spec["name"] for spec in specs] == ["x"]
    golden, trace = recorded(CHECK, specs[0], robot)
    measures = measures_on(CHECK, golden, trace, robot)
    assert measures
    assert failed(measures) == set()
    assert trace is not None
    moved = trace.columns["position:x" if actuator.startswith("<pos") else "velocity:x"][1]
    assert np.ptp(moved) > 1e-3


def test_a_step_starts_from_the_given_pose(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    spec = {**STEP, "stimulus": {**STEP["stimulus"], "pose": {"joints": {"x": "0.3 m"}}}}
    found = observe(CHECK, golden_of(CHECK, spec), robot).values
    assert found["final"] == pytest.approx(0.32, abs=1e-6)
    assert found["steady_state_error"] == pytest.approx(0.0, abs=1e-4)
