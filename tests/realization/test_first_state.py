"""Uncommanded or unrecorded joints hold their position or follow their equality constraint."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.realization.first_state import (
    follow_joint_equalities,
    holding_controls,
    settle_actuators,
    settle_under_load,
)

ARM = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" {upper}>
      <joint name="shoulder" axis="0 1 0" damping="1" {shoulder}/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1" contype="0" conaffinity="0"/>
      <body name="fore" pos=".3 0 0">
        <joint name="lift" type="slide" axis="0 0 1" damping="5"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".5" contype="0"
          conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>{drives}</actuator>
</mujoco>
"""
SERVOS = '<position joint="shoulder" kp="40" kv="2"/><position joint="lift" kp="300" kv="10"/>'
START = np.array([0.4, 0.03])


def simulate_uncommanded(text: str) -> mujoco.MjData:
    """State 2 s after a start at rest without commands."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:] = START
    data.ctrl[:] = holding_controls(model, data, ())
    for _ in range(2000):
        mujoco.mj_step(model, data)
    return data


@pytest.mark.parametrize(
    ("upper", "shoulder", "drives"),
    [
        ("", "", SERVOS),
        ("", "", SERVOS.replace('kp="40"', 'kp="40" gear="-3"')),
        ("", 'stiffness="5" springref="1"', SERVOS),
        ('gravcomp="0.7"', "", SERVOS),
        ('gravcomp="0.7"', 'actuatorgravcomp="true"', SERVOS),
        ("", "", SERVOS + '<position joint="shoulder" kp="25"/>'),
        ("", "", '<general joint="shoulder" biastype="affine" gainprm="7" biasprm="1.5 -30 -2"/>'
         '<position joint="lift" kp="300" kv="10"/>'),
    ],
    ids=["plain", "geared", "spring", "gravity compensation", "compensation by actuator",
         "two servos", "general"],
)  # fmt: skip
def test_uncommanded_servos_hold_their_joints_against_gravity(
    upper: str, shoulder: str, drives: str
) -> None:
    data = simulate_uncommanded(ARM.format(upper=upper, shoulder=shoulder, drives=drives))
    assert data.qpos == pytest.approx(START, abs=1e-7)


@pytest.mark.parametrize("gear", [1.0, -2.5])
def test_an_integrated_velocity_servo_starts_in_static_equilibrium(gear: float) -> None:
    drives = (
        f'<intvelocity joint="shoulder" kp="40" kv="2" gear="{gear}"/>'
        '<position joint="lift" kp="300" kv="10"/>'
    )
    model = mujoco.MjModel.from_xml_string(ARM.format(upper="", shoulder="", drives=drives))
    data = mujoco.MjData(model)
    data.qpos[:] = START
    data.ctrl[:] = holding_controls(model, data, ())
    settle_actuators(model, data)
    assert data.act[0] == pytest.approx(gear * START[0]), (
        "the integrator does not start at the joint position"
    )
    settle_under_load(model, data)
    for _ in range(2000):
        mujoco.mj_step(model, data)
    assert data.qpos == pytest.approx(START, abs=1e-7)


def test_holding_controls_are_zero_for_commanded_joints_and_non_servos() -> None:
    drives = SERVOS + '<motor joint="shoulder"/><velocity joint="lift" kv="3"/>'
    model = mujoco.MjModel.from_xml_string(ARM.format(upper="", shoulder="", drives=drives))
    data = mujoco.MjData(model)
    data.qpos[:] = START
    before = data.qpos.copy()
    control = holding_controls(model, data, ("shoulder",))
    assert control[[0, 2, 3]] == pytest.approx(0.0)
    assert control[1] == pytest.approx(START[1] + 0.5 * 9.81 * np.cos(START[0]) / 300.0, rel=0.01)
    assert (data.qpos == before).all()


def test_mimic_joints_start_at_position_and_velocity_of_their_equality() -> None:
    finger = '<body><joint name="{}" type="slide" ref="{}"/><geom size=".01"/></body>'
    names = (("a", 0.0), ("b", 0.1), ("c", 0.0), ("d", 0.0))
    bodies = "".join(finger.format(*each) for each in names)
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{bodies}</worldbody><equality>"
        '<joint joint1="c" joint2="b" polycoef="0 2 0 0 0"/>'
        '<joint joint1="b" joint2="a" polycoef="0.01 -1 3 0 0"/>'
        '<joint joint1="d" joint2="a" active="false"/></equality></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = 0.2, 0.5
    follow_joint_equalities(model, data, {0})
    b = 0.01 - 0.2 + 3.0 * 0.2**2
    slope = -1.0 + 6.0 * 0.2
    assert data.qpos == pytest.approx([0.2, 0.1 + b, 2.0 * b, 0.0])
    assert data.qvel == pytest.approx([0.5, slope * 0.5, 2.0 * slope * 0.5, 0.0])
