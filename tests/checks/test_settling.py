"""Settling against closed forms, and seen to fail on injected changes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bench_models import (
    MASS,
    failed,
    golden_of,
    load_text,
    measures_on,
    observe,
    recorded,
    servo,
    slider,
)

from pytest_twin.checks.settling import SAMPLES, Settling
from pytest_twin.errors import SimulationError, SpecError

CHECK = Settling()
STIFFNESS, DAMPING = 200.0, 12.0
LET_GO = {
    "stimulus": {"duration": "4 s", "displacement": {"x": "50 mm"}},
    "tolerance": {
        "position": "10 um",
        "settling_time": "2 ms",
        "energy_growth": "1 mJ",
        "penetration": "0.1 mm",
    },
}


def pendulum(damping: float = 0.3, timestep: float = 0.001, gravity: float = 9.81) -> str:
    """A rod of 1 kg at 0.4 m on a hinge across gravity, off its rest by 0.5 rad."""
    return f"""
    <mujoco>
      <compiler angle="radian"/>
      <option timestep="{timestep}" integrator="implicitfast" gravity="0 0 -{gravity}"/>
      <worldbody>
        <body name="rod">
          <joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}"/>
          <inertial pos="0 0 -0.4" mass="1" diaginertia="0.01 0.01 0.01"/>
        </body>
      </worldbody>
    </mujoco>"""


FLOOR = """
    <mujoco>
      <option timestep="0.002" integrator="implicitfast"/>
      <worldbody>
        <geom name="ground" type="plane" size="1 1 1" solref="{solref} 1"/>
        <body name="ball" pos="0 0 {height}">
          <freejoint name="base"/>
          <geom name="ball" type="sphere" size="0.05" mass="0.4"/>
        </body>
      </worldbody>
    </mujoco>"""


def test_a_servo_without_gravity_settles_as_the_closed_form(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    found = observe(CHECK, golden_of(CHECK, LET_GO), robot).values
    decay = DAMPING / (2.0 * MASS)
    omega = np.sqrt(STIFFNESS / MASS - decay**2)
    time = np.linspace(0.0, 4.0, 800_001)
    motion = (
        0.05 * np.exp(-decay * time) * (np.cos(omega * time) + decay / omega * np.sin(omega * time))
    )
    last = time[np.flatnonzero(np.abs(motion - motion[-1]) > 1e-4)[-1]]
    assert found["position"]["x"] == pytest.approx(motion[-1], abs=2e-5)
    assert found["settling_time"] == pytest.approx(last, abs=2e-3)
    assert found["penetration"] == 0.0
    # What the balance of a passive system misses is the timestep's, and goes with it.
    finer = load_text(
        tmp_path, slider(actuator=servo(STIFFNESS, DAMPING), timestep=0.00025), "finer.xml"
    )
    half = observe(CHECK, golden_of(CHECK, LET_GO), finer).values
    assert found["energy_growth"] < 2e-3 * 0.5 * STIFFNESS * 0.05**2
    assert half["energy_growth"] == pytest.approx(0.5 * found["energy_growth"], rel=0.1)


def test_energy_of_a_spring_is_counted(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(stiffness=STIFFNESS, damping=DAMPING))
    observation = observe(CHECK, golden_of(CHECK, LET_GO), robot)
    assert observation.values["energy_start"] == pytest.approx(0.5 * STIFFNESS * 0.05**2)
    assert observation.values["energy_end"] < 1e-6
    assert observation.trace is not None
    assert observation.trace.x.size == SAMPLES


def test_work_of_a_servo_is_not_growth_but_a_motor_out_of_nowhere_is(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    observation = observe(CHECK, golden_of(CHECK, LET_GO), robot)
    assert observation.trace is not None
    energy, work = (observation.trace.columns[name][1] for name in ("energy", "actuator_work"))
    assert energy.max() > 0.1  # the servo accelerates the cart
    assert work.max() > 0.1
    # Negative damping feeds a system: MuJoCo takes it as it comes.
    fed = load_text(tmp_path, slider(stiffness=STIFFNESS, damping=0.0))
    fed.model.dof_damping[0] = -2.0
    golden, trace = recorded(CHECK, LET_GO, fed)
    assert "energy_growth" in failed(measures_on(CHECK, golden, trace, fed))


def test_gravity_moves_the_rest_and_can_be_switched_off(tmp_path: Path) -> None:
    robot = load_text(tmp_path, pendulum(damping=2.0))
    spec = {
        "stimulus": {"duration": "4 s", "displacement": {"hinge": 0.5}},
        "tolerance": {"angle": "1 mrad"},
    }
    hanging = observe(CHECK, golden_of(CHECK, spec), robot).values
    floating = observe(
        CHECK,
        golden_of(CHECK, {**spec, "stimulus": {**spec["stimulus"], "gravity": False}}),
        robot,
    ).values
    assert hanging["angle"]["hinge"] == pytest.approx(0.0, abs=2e-3)
    assert floating["angle"]["hinge"] == pytest.approx(0.5)
    assert floating["settling_time"] == 0.0
    lost = hanging["energy_start"] - hanging["energy_end"]
    assert lost == pytest.approx(9.81 * 0.4 * (1.0 - np.cos(0.5)), rel=1e-3)


def test_what_never_settles_has_no_settling_time(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(stiffness=STIFFNESS))
    found = observe(CHECK, golden_of(CHECK, LET_GO), robot).values
    assert found["settling_time"] is None
    golden, trace = recorded(
        CHECK, LET_GO, load_text(tmp_path, slider(stiffness=STIFFNESS, damping=DAMPING))
    )
    measure = measures_on(CHECK, golden, trace, robot)["settling_time"]
    assert not measure.passed
    assert measure.subject == "robot: undefined now (it never comes to rest)"


def test_zero_input_sends_a_servo_to_zero(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, 60.0)))
    pose = {"joints": {"x": 0.1}}
    held, zero = (
        observe(
            CHECK,
            golden_of(CHECK, {"stimulus": {"duration": "3 s", "pose": pose, "input": name}}),
            robot,
        ).values["position"]["x"]
        for name in ("hold", "zero")
    )
    assert held == pytest.approx(0.1)
    assert zero == pytest.approx(0.0, abs=1e-5)


def test_a_free_body_rests_on_the_floor(tmp_path: Path) -> None:
    robot = load_text(tmp_path, FLOOR.format(solref=0.02, height=0.08))
    spec = {
        "stimulus": {"duration": "2 s"},
        "tolerance": {"position": "0.1 mm", "angle": "1 mrad", "penetration": "20 mm"},
    }
    golden, trace = recorded(CHECK, spec, robot)
    assert golden.expected is not None
    assert golden.expected["pose"]["base"][2] == pytest.approx(0.05, abs=1e-3)
    assert 0.0 < golden.expected["penetration"] < 0.02
    assert golden.expected["deepest"] == ["ground", "ball"]
    assert failed(measures_on(CHECK, golden, trace, robot)) == set()
    sunk = load_text(tmp_path, FLOOR.format(solref=0.2, height=0.08))
    assert {"position", "penetration"} <= failed(measures_on(CHECK, golden, trace, sunk))


def test_bodies_that_start_inside_each_other_feed_energy(tmp_path: Path) -> None:
    robot = load_text(tmp_path, FLOOR.format(solref=0.02, height=0.03))
    spec = {"stimulus": {"duration": "0.5 s"}, "tolerance": {"energy_growth": "1 mJ"}}
    golden, trace = recorded(CHECK, spec, robot)
    assert failed(measures_on(CHECK, golden, trace, robot)) == {"energy_growth"}
    free = {**spec, "stimulus": {"duration": "0.1 s", "contact": False}}
    golden, trace = recorded(CHECK, free, robot)
    assert failed(measures_on(CHECK, golden, trace, robot)) == set()


@pytest.mark.parametrize(
    ("change", "caught"),
    [
        ({}, set()),
        ({"damping": 1.2 * DAMPING}, {"settling_time"}),
        ({"friction": 0.5}, {"position", "settling_time"}),
        ({"stiffness": 0.5 * STIFFNESS}, {"settling_time"}),
    ],
)
def test_changes_are_caught(tmp_path: Path, change: dict[str, float], caught: set[str]) -> None:
    plain = {"stiffness": STIFFNESS, "damping": DAMPING}
    golden, trace = recorded(CHECK, LET_GO, load_text(tmp_path, slider(**plain)))
    found = failed(measures_on(CHECK, golden, trace, load_text(tmp_path, slider(**plain | change))))
    assert caught <= found
    assert bool(found) == bool(change)


def test_a_joint_that_is_gone_is_no_number(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(damping=1.0))
    golden, trace = recorded(CHECK, LET_GO, robot)
    renamed = load_text(tmp_path, slider(damping=1.0).replace('name="x"', 'name="y"'))
    with pytest.raises(SpecError, match=r"no hinge or slide joint of this name .*got 'x'"):
        observe(CHECK, golden, renamed)
    undisturbed = {**LET_GO, "stimulus": {"duration": "1 s"}}
    golden, trace = recorded(CHECK, undisturbed, robot)
    assert "position" in failed(measures_on(CHECK, golden, trace, renamed))


def test_a_diverging_model_names_time_and_joint(tmp_path: Path) -> None:
    text = slider(actuator=servo(1e9, 0.0), integrator="Euler", timestep=0.01)
    robot = load_text(tmp_path, text)
    with pytest.raises(SimulationError, match=r"joint 'x': the simulation diverged at [0-9.]+ s"):
        observe(CHECK, golden_of(CHECK, LET_GO), robot)


def test_mistakes_are_named_with_their_line(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider())
    wrong = {"target": {"joints": ["xx"]}, "stimulus": {"duration": "1 s"}}
    golden = golden_of(CHECK, wrong)
    with pytest.raises(SpecError) as caught:
        observe(CHECK, golden, robot)
    assert caught.value.line == golden.lines["target.joints"]
    assert caught.value.expected == "did you mean 'x'?"
    for stimulus in (
        {"duration": "0 s"},
        {"duration": "1 m"},
        {"duration": "1 s", "band": {"angle": 0}},
    ):
        with pytest.raises(SpecError):
            observe(CHECK, golden_of(CHECK, {"stimulus": stimulus}), robot)


def test_the_same_twice(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    first, second = (observe(CHECK, golden_of(CHECK, LET_GO), robot) for _ in range(2))
    assert first.values == second.values
    assert first.trace is not None
    assert second.trace is not None
    for name, (_, series) in first.trace.columns.items():
        np.testing.assert_array_equal(series, second.trace.columns[name][1])


def test_first_specs_pass_on_the_robot_they_were_made_for(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    specs = CHECK.first(robot)
    assert [spec["name"] for spec in specs] == ["gravity", "no_gravity"]
    for spec in specs:
        golden, trace = recorded(CHECK, spec, robot)
        measures = measures_on(CHECK, golden, trace, robot)
        assert failed(measures) == set()
        assert {"position", "energy_growth"} <= set(measures)


def test_depends_on_all_that_moves(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(1.0, 1.0)))
    parts = set(CHECK.depends(golden_of(CHECK, LET_GO), robot.structure))
    assert {"mujoco/joint:x", "mujoco/actuator:servo", "mujoco/inertia:cart"} <= parts
