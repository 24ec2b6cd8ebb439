"""Internal states of actuators at the start of a window within a motion."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.diagnosis.hidden_state import HiddenState
from pytest_twin.trial.setpoint import Setpoint

PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body>
    <joint name="swing" axis="0 1 0" damping=".3"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
  </body></worldbody>
  <actuator>{}</actuator>
</mujoco>
"""
STARTS = (0.0, 0.5, 1.1)
FIRST = 0.2


@pytest.mark.parametrize(
    ("mode", "drive"),
    [
        ("position", '<position joint="swing" kp="40" kv="2" timeconst=".08"/>'),
        ("velocity", '<intvelocity joint="swing" kp="40" kv="2"/>'),
    ],
    ids=["filter", "integrator"],
)
def test_the_actuator_state_at_a_window_start_is_that_of_the_whole_motion(
    mode: str, drive: str
) -> None:
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(drive))
    command_time = 0.01 * np.arange(150)
    command = 0.4 * np.sin(5.0 * command_time)
    command = command + FIRST if mode == "position" else command
    data = mujoco.MjData(model)
    data.qpos[0] = FIRST
    mujoco.mj_forward(model, data)
    # At rest an integrator's state holds the load, and a filter's state equals the command.
    data.act[0] = FIRST + (data.qfrc_bias[0] / 40.0 if mode == "velocity" else 0.0)
    time, position, velocity, activation = [], [], [], {}
    for k in range(600):
        time.append(data.time)
        position.append(data.qpos.copy())
        velocity.append(data.qvel.copy())
        activation[k] = float(data.act[0])
        data.ctrl[0] = command[int(data.time / 0.01 + 1e-6)]
        mujoco.mj_step(model, data)
    motion = (np.array(time), np.array(position), np.array(velocity))
    hidden = HiddenState(
        model, ("swing",), [mode], Setpoint(command_time, command[:, None], False), motion
    )
    states = [(position[round(s / 0.002)], velocity[round(s / 0.002)]) for s in STARTS]
    found = hidden.at(STARTS, states)
    for start, (q, v), rest in zip(STARTS, states, found, strict=True):
        assert rest.state["act"][0] == pytest.approx(activation[round(start / 0.002)], abs=1e-9)
        assert rest.state["qpos"] == pytest.approx(q)
        assert rest.state["qvel"] == pytest.approx(v)
    assert np.ptp([rest.state["act"][0] for rest in found]) > 0.05
