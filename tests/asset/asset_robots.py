"""Small robots in the form in which suppliers send them, and helpers for the tests of assets."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from importlib.metadata import distribution
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

ROBOTS = next(
    Path(str(file.locate())).resolve().parents[2]
    for file in distribution("example-robot-data").files or ()
    if file.name == "panda.urdf"
)
PANDA = ROBOTS / "panda_description/urdf/panda.urdf"
ALLEGRO = ROBOTS / "allegro_hand_description/urdf/allegro_right_hand.urdf"
FINGER = ROBOTS / "finger_edu_description/robots/finger_edu.urdf"
UR3 = ROBOTS / "ur_description/urdf/ur3.urdf"

CORNERS = np.array(
    [[0, 0, 0], [0.2, 0, 0], [0, 0.1, 0], [0, 0, 0.05], [0.2, 0.1, 0.05]], dtype=np.float64
)
TRIANGLES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4)]


def stl(scale: float = 1.0) -> bytes:
    """A polyhedron with five vertices as binary STL."""
    body = b"".join(
        struct.pack("<12fH", 0, 0, 0, *(scale * CORNERS[list(face)]).ravel(), 0)
        for face in TRIANGLES
    )
    return bytes(80) + struct.pack("<I", len(TRIANGLES)) + body


def dae(unit: float) -> str:
    """The same polyhedron as COLLADA, with Y up; one unit of length is ``unit`` metres."""
    points = " ".join(f"{value / unit:.9g}" for value in CORNERS.ravel())
    faces = " ".join(str(corner) for face in TRIANGLES for corner in face)
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><created>2020-01-01</created><modified>2020-01-01</modified>
    <unit name="unit" meter="{unit}"/><up_axis>Y_UP</up_axis></asset>
  <library_geometries><geometry id="g" name="g"><mesh>
    <source id="p"><float_array id="pa" count="15">{points}</float_array><technique_common>
      <accessor source="#pa" count="5" stride="3"><param name="X" type="float"/>
      <param name="Y" type="float"/><param name="Z" type="float"/></accessor>
    </technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles count="6"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g"/></node>
  </visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>"""


ARM = """<robot name="arm">
  <link name="base">
    <inertial><mass value="2"/><inertia ixx="0.01" iyy="0.01" izz="0.01"/></inertial>
    <collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision>
  </link>
  <link name="upper">
    <inertial><origin xyz="0 0 0.2" rpy="0.1 0.2 0.3"/><mass value="1.5"/>
      <inertia ixx="0.02" iyy="0.02" izz="0.003" ixy="0.0002"/></inertial>
    <visual><geometry>
      <mesh filename="package://arm_description/meshes/part.dae"/></geometry></visual>
    <collision><origin xyz="0 0 0.1"/>
      <geometry>
        <mesh filename="package://arm_description/meshes/part.stl" scale="0.001 0.001 0.001"/>
      </geometry></collision>
  </link>
  <link name="slider">
    <inertial><mass value="0.4"/><inertia ixx="0.001" iyy="0.001" izz="0.001"/></inertial>
    <collision><geometry><cylinder radius="0.02" length="0.1"/></geometry></collision>
  </link>
  <link name="left">
    <inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial>
    <collision><geometry><sphere radius="0.01"/></geometry></collision>
  </link>
  <link name="right">
    <inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial>
  </link>
  <link name="tcp"/>
  <joint name="lift" type="revolute">
    <origin xyz="0 0 0.05" rpy="0.3 0 0"/><parent link="base"/><child link="upper"/>
    <axis xyz="0 2 1"/><limit lower="-1.5" upper="2" velocity="3" effort="40"/>
    <dynamics damping="0.4" friction="0.2"/>
    <safety_controller soft_lower_limit="-1.4" soft_upper_limit="1.9" k_position="20"
      k_velocity="5"/>
  </joint>
  <joint name="extend" type="prismatic">
    <origin xyz="0 0 0.3"/><parent link="upper"/><child link="slider"/>
    <axis xyz="0 0 1"/><limit lower="-0.1" upper="0.2" velocity="0.5" effort="100"/>
  </joint>
  <joint name="left" type="revolute">
    <origin xyz="0.02 0 0.1"/><parent link="slider"/><child link="left"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="2" effort="3"/>
  </joint>
  <joint name="right" type="revolute">
    <origin xyz="-0.02 0 0.1"/><parent link="slider"/><child link="right"/>
    <axis xyz="1 0 0"/><limit lower="-2" upper="2" velocity="2" effort="3"/>
    <mimic joint="left" multiplier="-0.5" offset="0.1"/>
  </joint>
  <joint name="tool" type="fixed">
    <origin xyz="0 0 0.15" rpy="0 0.5 0"/><parent link="slider"/><child link="tcp"/>
  </joint>
  <transmission name="lift_transmission">
    <type>transmission_interface/SimpleTransmission</type>
    <joint name="lift"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
    <actuator name="lift_motor"><mechanicalReduction>50</mechanicalReduction></actuator>
  </transmission>
  <gazebo reference="upper">
    <mu1>0.7</mu1>
    <sensor name="wrist_imu" type="imu"><pose>0 0 0.1 0 0 1.5707963267948966</pose></sensor>
    <sensor name="eye" type="camera"/>
  </gazebo>
</robot>
"""


def write_arm(folder: Path, text: str = ARM) -> Path:
    """Write the arm as a ROS package and return the path of its URDF."""
    package = folder / "arm_description"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    (package / "package.xml").write_text("<package><name>arm_description</name></package>")
    (package / "meshes" / "part.stl").write_bytes(stl(1000.0))
    (package / "meshes" / "part.dae").write_text(dae(0.01))
    urdf = package / "urdf" / "arm.urdf"
    urdf.write_text(text)
    return urdf


def _numbers(count: int, most: float) -> st.SearchStrategy[list[float]]:
    one = st.floats(-most, most, allow_nan=False)
    return st.lists(one, min_size=count, max_size=count)


def _words(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


@st.composite
def random_urdf(draw: st.DrawFn) -> str:
    """A tree of up to seven links with oblique joint axes and rotated inertias."""
    count = draw(st.integers(2, 7))
    links = []
    joints = []
    for index in range(count):
        sides = np.abs(draw(_numbers(3, 0.3))) + 0.02
        mass = draw(st.floats(0.05, 5.0))
        x, y, z = mass / 12 * (sides**2).sum() - mass / 12 * sides**2
        links.append(
            f'<link name="l{index}"><inertial><origin xyz="{_words(draw(_numbers(3, 0.2)))}" '
            f'rpy="{_words(draw(_numbers(3, 1.5)))}"/><mass value="{mass!r}"/>'
            f'<inertia ixx="{float(x)!r}" iyy="{float(y)!r}" izz="{float(z)!r}"/></inertial></link>'
        )
        if index == 0:
            continue
        kind = draw(st.sampled_from(["revolute", "continuous", "prismatic", "fixed"]))
        axis = np.array(draw(_numbers(3, 1.0)))
        if np.linalg.norm(axis) < 0.1:
            axis = np.array([0.0, 0.6, 0.8])
        parent = draw(st.integers(0, index - 1))
        joints.append(
            f'<joint name="j{index}" type="{kind}"><parent link="l{parent}"/>'
            f'<child link="l{index}"/><origin xyz="{_words(draw(_numbers(3, 0.5)))}" '
            f'rpy="{_words(draw(_numbers(3, 3.0)))}"/><axis xyz="{_words(axis)}"/>'
            '<limit lower="-1" upper="1" effort="10" velocity="1"/></joint>'
        )
    return f'<robot name="random">{"".join(links)}{"".join(joints)}</robot>'
