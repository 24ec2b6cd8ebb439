"""Settling compared with closed forms, and its failure on changed models."""

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
RELEASE = {
    "stimulus": {"duration": "4 s", "displacement": {"x": "50 mm"}},
    "tolerance": {
        "position": "10 um",
        "settling_time": "2 ms",
        "energy_growth": "1 mJ",
        "penetration": "0.1 mm",
    },
}


def pendulum(damping: float = 0.3, timestep: float = 0.001, gravity: float = 9.81) -> str:
    """MJCF text of a pendulum of 1 kg at 0.4 m."""
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


def test_settling_of_a_servo_equals_the_closed_form(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    found = observe(CHECK, golden_of(CHECK, RELEASE), robot).values
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
    # The energy error of a passive system is caused by the timestep and proportional to it.
    finer = load_text(
        tmp_path, slider(actuator=servo(STIFFNESS, DAMPING), timestep=0.00025), "finer.xml"
    )
    half = observe(CHECK, golden_of(CHECK, RELEASE), finer).values
    assert found["energy_growth"] < 2e-3 * 0.5 * STIFFNESS * 0.05**2
    assert half["energy_growth"] == pytest.approx(0.5 * found["energy_growth"], rel=0.1)


def test_energy_includes_the_potential_energy_of_a_spring(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(stiffness=STIFFNESS, damping=DAMPING))
    observation = observe(CHECK, golden_of(CHECK, RELEASE), robot)
    assert observation.values["energy_start"] == pytest.approx(0.5 * STIFFNESS * 0.05**2)
    assert observation.values["energy_end"] < 1e-6
    assert observation.trace is not None
    assert observation.trace.x.size == SAMPLES


def test_servo_work_is_not_energy_growth_but_negative_damping_is(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    observation = observe(CHECK, golden_of(CHECK, RELEASE), robot)
    assert observation.trace is not None
    energy, work = (observation.trace.columns[name][1] for name in ("energy", "actuator_work"))
    assert energy.max() > 0.1  # the servo accelerates the cart
    assert work.max() > 0.1
    # Negative damping adds energy; MuJoCo accepts it.
    fed = load_text(tmp_path, slider(stiffness=STIFFNESS, damping=0.0))
    fed.model.dof_damping[0] = -2.0
    golden, trace = recorded(CHECK, RELEASE, fed)
    assert "energy_growth" in failed(measures_on(CHECK, golden, trace, fed))


def test_gravity_determines_the_rest_position_and_can_be_disabled(tmp_path: Path) -> None:
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


def test_an_undamped_joint_has_no_settling_time(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(stiffness=STIFFNESS))
    found = observe(CHECK, golden_of(CHECK, RELEASE), robot).values
    assert found["settling_time"] is None
    golden, trace = recorded(
        CHECK, RELEASE, load_text(tmp_path, slider(stiffness=STIFFNESS, damping=DAMPING))
    )
    measure = measures_on(CHECK, golden, trace, robot)["settling_time"]
    assert not measure.passed
    assert measure.subject == "robot: undefined now (it does not come to rest)"


def test_zero_input_moves_a_servo_to_zero_and_hold_keeps_it(tmp_path: Path) -> None:
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


def test_a_free_body_settles_on_the_floor_with_small_penetration(tmp_path: Path) -> None:
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


def test_overlapping_bodies_fail_by_energy_growth(tmp_path: Path) -> None:
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
def test_changed_dynamics_fail_the_expected_settling_measures(
    tmp_path: Path, change: dict[str, float], caught: set[str]
) -> None:
    plain = {"stiffness": STIFFNESS, "damping": DAMPING}
    golden, trace = recorded(CHECK, RELEASE, load_text(tmp_path, slider(**plain)))
    found = failed(measures_on(CHECK, golden, trace, load_text(tmp_path, slider(**plain | change))))
    assert caught <= found
    assert bool(found) == bool(change)


def test_a_renamed_joint_is_refused_or_fails(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(damping=1.0))
    golden, trace = recorded(CHECK, RELEASE, robot)
    renamed = load_text(tmp_path, slider(damping=1.0).replace('name="x"', 'name="y"'))
    with pytest.raises(SpecError, match=r"no hinge or slide joint of this name .*got 'x'"):
        observe(CHECK, golden, renamed)
    undisturbed = {**RELEASE, "stimulus": {"duration": "1 s"}}
    golden, trace = recorded(CHECK, undisturbed, robot)
    assert "position" in failed(measures_on(CHECK, golden, trace, renamed))


def test_a_diverging_model_is_reported_with_time_and_joint(tmp_path: Path) -> None:
    text = slider(actuator=servo(1e9, 0.0), integrator="Euler", timestep=0.01)
    robot = load_text(tmp_path, text)
    with pytest.raises(SimulationError, match=r"joint 'x': the simulation diverged at [0-9.]+ s"):
        observe(CHECK, golden_of(CHECK, RELEASE), robot)


def test_invalid_settling_specs_are_refused_with_their_line(tmp_path: Path) -> None:
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


def test_repeated_settling_runs_are_identical(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    first, second = (observe(CHECK, golden_of(CHECK, RELEASE), robot) for _ in range(2))
    assert first.values == second.values
    assert first.trace is not None
    assert second.trace is not None
    for name, (_, series) in first.trace.columns.items():
        np.testing.assert_array_equal(series, second.trace.columns[name][1])


def test_proposed_settling_goldens_pass(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(STIFFNESS, DAMPING)))
    specs = CHECK.first(robot)
    assert [spec["name"] for spec in specs] == ["gravity", "no_gravity"]
    for spec in specs:
        golden, trace = recorded(CHECK, spec, robot)
        measures = measures_on(CHECK, golden, trace, robot)
        assert failed(measures) == set()
        assert {"position", "energy_growth"} <= set(measures)


def test_settling_depends_on_joints_actuators_and_inertias(tmp_path: Path) -> None:
    robot = load_text(tmp_path, slider(actuator=servo(1.0, 1.0)))
    parts = set(CHECK.depends(golden_of(CHECK, RELEASE), robot.structure))
    assert {"mujoco/joint:x", "mujoco/actuator:servo", "mujoco/inertia:cart"} <= parts
