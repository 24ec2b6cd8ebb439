"""Small robot models for the tests of this folder, and paths of real ones."""

from __future__ import annotations

import os
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest

PENDULUM = """<mujoco model="pendulum">
  <compiler angle="radian"/>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 -0.1" mass="0.5" diaginertia="1e-4 1e-4 1e-5"/>
      <joint name="swing" axis="0 1 0" damping="0.05"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01"/>
      <site name="tip" pos="0 0 -0.2"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="swing" kp="10" kv="1" forcerange="-2 2"/>
  </actuator>
</mujoco>
"""

ARM = """<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial>
      <origin xyz="0.1 0 0" rpy="0 0 0.3"/>
      <mass value="2"/>
      <inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001" ixz="0" iyz="0"/>
    </inertial>
    <collision><geometry><box size="0.2 0.1 0.1"/></geometry></collision>
  </link>
  <link name="lower">
    <inertial>
      <origin xyz="0.05 0.01 0"/>
      <mass value="1"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <link name="tool"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.3" rpy="0.1 -0.2 0.3"/>
    <axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" effort="40" velocity="3"/>
    <dynamics damping="0.7" friction="0.2"/>
  </joint>
  <joint name="elbow" type="prismatic">
    <parent link="upper"/><child link="lower"/>
    <origin xyz="0.2 0 0" rpy="0 0 1"/>
    <axis xyz="1 0 2"/>
    <limit lower="0" upper="0.4" effort="100" velocity="0.5"/>
  </joint>
  <joint name="flange" type="fixed">
    <parent link="lower"/><child link="tool"/>
    <origin xyz="0 0 0.1" rpy="0 1.5707963267948966 0"/>
  </joint>
</robot>
"""


def written(folder: Path, text: str, name: str = "model.xml") -> Path:
    """Write the text to a file and return its path."""
    path = folder / name
    path.write_text(text)
    return path


def example_robot(name: str) -> Path:
    """Path of a URDF of the package example-robot-data with this file name."""
    try:
        files = distribution("example-robot-data").files or []
    except PackageNotFoundError:
        pytest.skip("example-robot-data is not installed")
    return next(Path(str(file.locate())) for file in files if str(file).endswith(f"/{name}"))


def recordings() -> Path:
    """The folder of real recordings; skips if it is missing."""
    default = Path(__file__).parents[2].parent / "shared/recordings"
    folder = Path(os.environ.get("TWIN_RECORDINGS", default))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}; TWIN_RECORDINGS says where they are")
    return folder
