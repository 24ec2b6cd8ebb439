"""A pendulum with a servo, whose true plant has effects that the model lacks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries

MODEL = """\
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 -0.1" mass="0.5" diaginertia="1e-4 1e-4 1e-4"/>
      <joint name="a" axis="0 -1 0" damping="{damping}" frictionloss="{dry}" armature="0.001"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="a" kp="1.0"/></actuator>
</mujoco>
"""


def model(damping: float = 0.05, dry: float = 0.0) -> str:
    return MODEL.format(damping=damping, dry=dry)


def record(
    path: Path,
    xml: str,
    *,
    seconds: float = 4.0,
    force: Callable[[float, float], float] = lambda q, v: 0.0,
    phase: float = 0.0,
) -> Path:
    """A recording of the plant at 100 Hz; ``force(position, velocity)`` also acts on the joint."""
    plant = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(plant)
    time, states, commands = [], [], []
    for step in range(round(seconds / plant.opt.timestep)):
        t = step * plant.opt.timestep
        if step % 5 == 0:
            data.ctrl[0] = 0.6 * np.sin(2.0 * t + phase) + 0.3 * np.sin(5.0 * t)
            time.append(t)
            states.append([data.qpos[0], data.qvel[0]])
            commands.append([data.ctrl[0]])
        data.qfrc_applied[0] = force(data.qpos[0], data.qvel[0])
        mujoco.mj_step(plant, data)
    stamps = np.rint(1e9 * np.array(time)).astype(np.int64) + 10**18
    table = np.array(states)
    write_recording(
        path,
        [
            JointSeries("/joint_states", ("a",), stamps, stamps, table[:, :1], table[:, 1:], None),
            JointSeries("/joint_commands", ("a",), stamps, stamps, np.array(commands), None, None),
        ],
        {"command_between": "held"},
    )
    return path
