"""Mapping of commands to MuJoCo controls: input, scale, and start at rest."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from replay_trials import model, slider, trial

from pytest_twin.errors import SpecError
from pytest_twin.open_loop import Row, replay_rows
from pytest_twin.realization.engine import GAIN_PID
from pytest_twin.realization.inputs import command_input

POSITION_SERVOS = {
    "position": '<position joint="x" kp="300" kv="60"/>',
    "geared": '<position joint="x" kp="300" kv="60" gear="-2.5"/>',
    "filtered": '<position joint="x" kp="300" kv="60" timeconst="0.05"/>',
    "delayed": '<position joint="x" kp="300" kv="60" delay="0.02" nsample="30"/>',
    "general": '<general joint="x" gainprm="600" biastype="affine" biasprm="0 -300 -60"/>',
    "pid": '<pid joint="x" kp="300" kv="60"/>',
    "pid rate limit": '<pid joint="x" kp="300" kv="60" slewmax="2"/>',
    "pid feedforward": '<pid joint="x" kp="300" kv="60" input="pos vel ff"/>',
    "dc motor": '<dcmotor joint="x" motorconst="0.5" resistance="1" input="pos vel" '
    'controller="300 0 60 0 0 0"/>',
    "dc motor rate limit": '<dcmotor joint="x" motorconst="0.5" resistance="1" input="pos vel" '
    'controller="300 0 60 2 0 0"/>',
    "with an additional motor": '<motor joint="x"/><position joint="x" kp="300" kv="60"/>',
}


def slider_model(actuator: str) -> mujoco.MjModel:
    if GAIN_PID < 0 and ("<pid" in actuator or 'input="pos' in actuator):
        pytest.skip("this MuJoCo has no pid, nor these inputs of a dcmotor")
    return model(slider(actuator))


@pytest.mark.parametrize("name", POSITION_SERVOS)
def test_a_position_servo_starts_settled_and_reaches_its_command(name: str) -> None:
    time = np.arange(0, 3.0, 0.01)
    made = trial(time, 0.5, np.array([0.0, 1.0]), np.array([0.5, -0.2]))
    (result,) = replay_rows([Row(made, slider_model(POSITION_SERVOS[name]))])
    # Filters, delays and rate limits start settled: the joint rests until the command changes.
    assert np.abs(result.position[:100, 0] - 0.5).max() < 1e-9
    assert result.position[-1, 0] == pytest.approx(-0.2, abs=1e-4)


VELOCITY_SERVOS = {
    "velocity": '<velocity joint="x" kv="60"/>',
    "geared": '<velocity joint="x" kv="60" gear="3"/>',
    "integrated": '<intvelocity joint="x" kp="4000" kv="60"/>',
    "scaled integrator": '<general joint="x" dyntype="integrator" gainprm="8000" '
    'biastype="affine" biasprm="0 -4000 -60"/>',
    "pid": '<pid joint="x" kp="0" kv="60" input="vel"/>',
}


@pytest.mark.parametrize("name", VELOCITY_SERVOS)
def test_a_velocity_servo_starts_settled_and_reaches_its_speed(name: str) -> None:
    time = np.arange(0, 3.0, 0.01)
    made = trial(time, 0.7, np.array([0.0, 1.0]), np.array([0.0, 0.25]), mode="velocity")
    (result,) = replay_rows([Row(made, slider_model(VELOCITY_SERVOS[name]))])
    assert np.abs(result.position[:100, 0] - 0.7).max() < 1e-9
    assert result.velocity[-1, 0] == pytest.approx(0.25, abs=1e-3)


@pytest.mark.parametrize(
    "motor",
    [
        '<motor joint="x"/>',
        '<motor joint="x" gear="50"/>',
        '<general joint="x" gainprm="0.2" gear="-4"/>',
        '<pid joint="x" kp="0" kv="0" input="ff"/>',
    ],
)
def test_an_effort_command_is_the_joint_torque_for_any_gear_ratio(motor: str) -> None:
    time = np.arange(0, 0.5, 0.01)
    made = trial(time, 0.0, np.array([0.0]), np.array([3.0]), mode="effort")
    (result,) = replay_rows([Row(made, slider_model(motor))])
    assert result.effort[10, 0] == pytest.approx(3.0)
    assert np.abs(result.position[:, 0] - 0.75 * time**2).max() < 1e-9


def test_an_uncommanded_joint_holds_its_recorded_or_reference_position() -> None:
    text = """
    <mujoco><option gravity="0 0 0"/><worldbody>
      <body><joint name="x" type="slide"/><geom size="0.1"/></body>
      <body><joint name="held" type="slide"/><geom size="0.1"/></body>
      <body><joint name="other" type="slide" ref="0.4"/><geom size="0.1"/></body>
    </worldbody><option><flag contact="disable"/></option><actuator>
      <position joint="x" kp="300" kv="60"/><position joint="held" kp="300" kv="60"/>
      <position joint="other" kp="300" kv="60"/>
    </actuator></mujoco>"""
    time = np.arange(0, 1.0, 0.01)
    made = trial(
        time, (0.1, -0.3), np.array([0.0]), np.array([0.1]),
        joints=("x", "held"), command_joints=("x",),
    )  # fmt: skip
    (result,) = replay_rows([Row(made, model(text))])
    assert np.abs(result.qpos - [0.1, -0.3, 0.4]).max() < 1e-12


def test_a_mimic_joint_starts_at_the_position_of_its_equality() -> None:
    text = """
    <mujoco><option gravity="0 0 0"/><worldbody>
      <body><joint name="x" type="slide"/><geom size="0.1" contype="0" conaffinity="0"/></body>
      <body><joint name="mimic" type="slide"/>
        <geom size="0.1" contype="0" conaffinity="0"/></body>
    </worldbody>
    <equality><joint joint1="mimic" joint2="x" polycoef="0.1 -2 0 0 0"/></equality>
    <actuator><position joint="x" kp="300" kv="60"/></actuator></mujoco>"""
    made = trial(np.arange(0, 0.5, 0.01), 0.25, np.array([0.0]), np.array([0.25]))
    (result,) = replay_rows([Row(made, model(text))])
    assert np.abs(result.qpos - [0.25, -0.4]).max() < 1e-9


@pytest.mark.parametrize(
    ("actuators", "mode", "words"),
    [
        (
            '<position name="servo" joint="x"/>',
            "effort",
            "joint 'x': no actuator takes effort commands (got 'servo (position)'; expected an "
            "actuator of this joint with effort as its input)",
        ),
        (
            "",
            "position",
            "joint 'x': no actuator takes position commands (got 'no actuator'; expected an "
            "actuator of this joint with position as its input)",
        ),
        (
            '<motor name="a" joint="x"/><motor name="b" joint="x"/>',
            "effort",
            "joint 'x': more than one actuator takes effort commands "
            "(got 'a (effort), b (effort)'; expected one)",
        ),
    ],
)
def test_a_command_mode_needs_exactly_one_matching_actuator(
    actuators: str, mode: str, words: str
) -> None:
    with pytest.raises(SpecError) as refusal:
        command_input(model(slider(actuators)), "x", mode)  # type: ignore[arg-type]
    assert str(refusal.value) == words
