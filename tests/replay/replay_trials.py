"""Helpers: trials made from arrays, and small models to replay them on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.formats.mcap import JointSeries, Recording
from pytest_twin.trial import CommandMode, Trial, make_trial

START_NS = 1_700_000_000_000_000_000


def series(
    topic: str, names: tuple[str, ...], time: np.ndarray, **fields: np.ndarray | None
) -> JointSeries:
    stamp = START_NS + np.rint(np.asarray(time) * 1e9).astype(np.int64)
    filled = {"position": None, "velocity": None, "effort": None} | {
        key: None if value is None else np.asarray(value, float).reshape(len(stamp), len(names))
        for key, value in fields.items()
    }
    return JointSeries(topic, names, stamp, stamp, **filled)


def recording(
    state: JointSeries | None,
    command: JointSeries | None,
    metadata: Mapping[str, str] | None = None,
) -> Recording:
    found = {"state": state, "command": command}
    return Recording(
        Path("made.mcap"), {k: v for k, v in found.items() if v}, dict(metadata or {}), ()
    )


def trial(
    time: np.ndarray,
    start: np.ndarray | float,
    command_time: np.ndarray,
    command: np.ndarray,
    *,
    mode: CommandMode = "position",
    joints: tuple[str, ...] = ("x",),
    command_joints: tuple[str, ...] | None = None,
    velocity: np.ndarray | float | None = None,
    metadata: Mapping[str, str] | None = None,
) -> Trial:
    """A trial with wrong states (1e3) after the first: a replay must not read them."""
    position = np.full((len(time), len(joints)), 1e3)
    position[0] = start
    speeds = None
    if velocity is not None:
        speeds = np.full_like(position, 1e3)
        speeds[0] = velocity
    command_joints = joints if command_joints is None else command_joints
    return make_trial(
        recording(
            series("/joint_states", joints, time, position=position, velocity=speeds),
            series("/joint_commands", command_joints, command_time, **{mode: command}),
            metadata,
        )
    )


def model(text: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(text)


def slider(actuator: str, *, mass: float = 2.0, timestep: float = 1e-3, more: str = "") -> str:
    """MJCF text of a mass (kg) on a slide joint ``x`` without gravity, with ``actuator``."""
    return f"""
    <mujoco>
      <option timestep="{timestep}" integrator="RK4" gravity="0 0 0"/>
      <worldbody><body>
        <joint name="x" type="slide" axis="1 0 0"/>
        <geom size="0.1" mass="{mass}" contype="0" conaffinity="0"/>
      </body></worldbody>
      <actuator>{actuator}</actuator>{more}
    </mujoco>"""


ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><joint damping="0.1" frictionloss="0.05" armature="0.01"/></default>
  <worldbody>
    <body pos="0 0 1"><joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
      <body pos="0.3 0 0"><joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.5"/>
        <site name="tool" pos="0.25 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="200" kv="10" forcerange="-20 20"/>
    <position name="elbow" joint="elbow" kp="80" kv="4" forcerange="-10 10"/>
  </actuator>
</mujoco>"""
