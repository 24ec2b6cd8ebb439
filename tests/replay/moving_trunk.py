"""A trunk that an ideal gantry moves and turns, with a leg of two joints; its recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

BODY = """
<mujoco><option timestep="{step}"/><worldbody>{around}<body name="trunk" pos="0 0 1">{base}
  <geom size=".1" mass="5"/><site name="imu" pos="0.1 0 0.05" euler="0 30 0"/>
  <body name="leg"><joint name="hip" axis="0 1 0" damping=".05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1"/>
    <body name="foot" pos="0 0 -.3"><joint name="knee" axis="0 1 0" damping="{damping}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".5"/></body></body></body>
</worldbody><actuator><position name="hip" joint="hip" kp="20" kv=".5"/>
  <position name="knee" joint="knee" kp="6" kv=".2"/>{drives}</actuator></mujoco>"""
FREE = BODY.format(step=0.002, around="", base="<freejoint/>", damping=0.05, drives="")
AXES = {"x": "1 0 0", "z": "0 0 1", "yaw": "0 0 1", "pitch": "0 1 0"}
COLUMNS = [f"base.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
JOINTS = ("hip", "knee")


@dataclass(frozen=True)
class Motion:
    """What a recording contains.

    Attributes:
        seconds: its duration, s.
        step: timestep of the plant, s.
        added_damping: damping of the knee beyond the model's, N*m*s/rad.
        noise: standard deviation of the positions, rad.
    """

    seconds: float = 4.0
    step: float = 0.0005
    added_damping: float = 0.0
    noise: float = 4e-4


@dataclass(frozen=True)
class MovedTrunk:
    """Columns at 100 Hz; commands change between the samples, and poses are x y z qw qx qy qz."""

    time: np.ndarray
    position: np.ndarray
    command: np.ndarray
    effort: np.ndarray
    pose: np.ndarray

    def write(self, path: Path, *, efforts: bool = False, pose: np.ndarray | None = None) -> Path:
        """Write a CSV file, whose poses may be others."""
        names = [f"{joint}.{what}" for what in ("position", "command") for joint in JOINTS]
        columns = [self.time, self.position, self.command]
        if efforts:
            names += [f"{joint}.effort" for joint in JOINTS]
            columns.append(self.effort)
        table = np.column_stack([*columns, self.pose if pose is None else pose])
        head = ",".join(["time", *names, *COLUMNS])
        np.savetxt(path, table, "%.9g", ",", header=head, comments="")
        return path


def moved_trunk(seed: int, motion: Motion) -> MovedTrunk:
    """A recording of the plant: the gantry moves sideways and up, and turns; so do the joints."""
    random = np.random.default_rng(seed)
    rates = np.array([2.0, 3.0, 5.0, 7.0, 1.0, 4.0]) * random.uniform(0.7, 1.2, 6)
    gantry = "".join(
        f'<joint name="{name}" type="{"slide" if name in "xz" else "hinge"}" axis="{axis}" '
        'armature="500"/>'
        for name, axis in AXES.items()
    )
    drives = "".join(f'<position name="{n}" joint="{n}" kp="2e6" kv="4e4"/>' for n in AXES)
    text = BODY.format(
        step=motion.step, around="", base=gantry, damping=0.05 + motion.added_damping, drives=drives
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    rows = []
    for k in range(round(motion.seconds / motion.step)):
        time = k * motion.step
        sine = np.sin(rates * time)
        commands = np.array([0.3, -0.4]) * sine[:2]
        ramp = np.clip(time, 0.0, 1.0) ** 2 * (3.0 - 2.0 * np.clip(time, 0.0, 1.0))
        course = ramp * np.array([0.2 * sine[2], 0.1 * sine[3], rates[4] * time, 0.4 * sine[5]])
        data.ctrl[:] = [*commands, *course]
        mujoco.mj_forward(model, data)
        if k % round(0.01 / motion.step) == 0:
            trunk, quaternion = data.body("trunk"), np.empty(4)
            mujoco.mju_mat2Quat(quaternion, trunk.xmat.copy())
            positions = data.qpos[-2:] + motion.noise * random.standard_normal(2)
            efforts = data.qfrc_actuator[-2:] + 0.002 * random.standard_normal(2)
            rows.append([time, *positions, *commands, *efforts, *trunk.xpos, *quaternion])
        mujoco.mj_step(model, data)
    table = np.array(rows)
    return MovedTrunk(table[:, 0], table[:, 1:3], table[:, 3:5], table[:, 5:7], table[:, 7:])
