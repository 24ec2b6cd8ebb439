"""A robot without faults, helpers that insert faults, and helpers that audit it."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pytest_twin.audit import finding
from pytest_twin.audit.audit_file import audit
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.geometry import Geometry
from pytest_twin.audit.read import read

# The upper link is a solid bar of 0.3 x 0.06 x 0.06 m and 2 kg: I = m/12 (b^2 + c^2).
CLEAN = """<?xml version="1.0"?>
<robot name="clean">
  <link name="world"/>
  <link name="base">
    <collision><origin xyz="0 0 0.05"/><geometry><box size="0.2 0.2 0.1"/></geometry></collision>
  </link>
  <joint name="mount" type="fixed">
    <parent link="world"/>
    <child link="base"/>
  </joint>
  <link name="upper">
    <inertial>
      <origin xyz="0.15 0 0"/>
      <mass value="2"/>
      <inertia ixx="0.0012" iyy="0.0156" izz="0.0156" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.06 0.06"/></geometry></visual>
    <collision><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.06 0.06"/></geometry></collision>
  </link>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.15" rpy="0 0 0"/>
    <parent link="base"/>
    <child link="upper"/>
    <axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="1.5" velocity="2" effort="50"/>
    <dynamics damping="0.1" friction="0.2"/>
  </joint>
  <link name="lower">
    <inertial>
      <origin xyz="0.1 0 0"/>
      <mass value="1.3"/>
      <inertia ixx="0.00052" iyy="0.0046" izz="0.0046" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <collision>
      <origin xyz="0.1 0 0"/>
      <geometry><mesh filename="bar.stl"/></geometry>
    </collision>
  </link>
  <joint name="elbow" type="revolute">
    <origin xyz="0.32 0 0" rpy="0 0 0"/>
    <parent link="upper"/>
    <child link="lower"/>
    <axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="2" effort="20"/>
    <dynamics damping="0.1" friction="0.2"/>
  </joint>
  <link name="finger">
    <inertial>
      <origin xyz="0.02 0 0"/>
      <mass value="0.1"/>
      <inertia ixx="4e-6" iyy="1.7e-5" izz="1.7e-5" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <collision>
      <origin xyz="0.02 0 0"/>
      <geometry><box size="0.04 0.015 0.015"/></geometry>
    </collision>
  </link>
  <joint name="grip" type="prismatic">
    <origin xyz="0.23 0 0"/>
    <parent link="lower"/>
    <child link="finger"/>
    <axis xyz="0 1 0"/>
    <limit lower="0" upper="0.02" velocity="0.1" effort="10"/>
    <dynamics damping="1" friction="0.5"/>
  </joint>
  <link name="thumb">
    <inertial>
      <origin xyz="0.02 0 0"/>
      <mass value="0.11"/>
      <inertia ixx="4e-6" iyy="1.8e-5" izz="1.8e-5" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <collision>
      <origin xyz="0.02 0 0"/>
      <geometry><box size="0.04 0.016 0.016"/></geometry>
    </collision>
  </link>
  <joint name="thumb_slide" type="prismatic">
    <origin xyz="0.23 -0.03 0"/>
    <parent link="lower"/>
    <child link="thumb"/>
    <axis xyz="0 -1 0"/>
    <limit lower="0" upper="0.02" velocity="0.1" effort="10"/>
    <dynamics damping="1" friction="0.5"/>
    <mimic joint="grip" multiplier="1"/>
  </joint>
  <link name="tcp"/>
  <joint name="tcp_mount" type="fixed">
    <origin xyz="0.3 0 0"/>
    <parent link="lower"/>
    <child link="tcp"/>
  </joint>
</robot>
"""


def box_stl(size: tuple[float, float, float], *, leave_out: int = 0) -> bytes:
    """A binary STL of a box of ``size`` (m) without its last ``leave_out`` triangles."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corner = corner * np.array(size) / 2
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    faces = faces[: len(faces) - leave_out]
    data = b"\0" * 80 + struct.pack("<I", len(faces))
    for face in faces:
        data += struct.pack("<12fH", 0, 0, 0, *corner[list(face)].ravel(), 0)
    return data


def write_clean(folder: Path, text: str = CLEAN, name: str = "robot.urdf") -> Path:
    """Write a robot description and the mesh of the clean robot into a folder."""
    (folder / "bar.stl").write_bytes(box_stl((0.2, 0.05, 0.05)))
    path = folder / name
    path.write_text(text)
    return path


def changed(*pairs: tuple[str, str]) -> str:
    """The clean robot with each text replaced; each must occur exactly once."""
    text = CLEAN
    for old, new in pairs:
        assert text.count(old) == 1, (old, text.count(old))
        text = text.replace(old, new)
    return text


def line_of(text: str, part: str) -> int:
    """1-based line number of the first occurrence of ``part``."""
    return text[: text.index(part)].count("\n") + 1


def findings_of(path: Path, known: Evidence | None = None) -> list[dict[str, Any]]:
    """Findings of all audit layers that need no simulator."""
    asset = read(path)
    return finding.to_json(audit(asset, known or Evidence(), Geometry(asset)))


def only(rows: list[dict[str, Any]], code: str) -> list[Mapping[str, Any]]:
    """The findings with this code."""
    return [row for row in rows if row["code"] == code]


def robots() -> Path:
    """The folder with the robots of example-robot-data; skips if it is missing."""
    try:
        found = distribution("example-robot-data")
    except PackageNotFoundError:
        pytest.skip("example-robot-data is not installed")
    folder = Path(str(found.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    if not folder.is_dir():
        pytest.skip("example-robot-data has no robots here")
    return folder
