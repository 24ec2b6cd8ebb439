"""If mesh and inertia contradict each other, the implausible one is reported."""

from __future__ import annotations

from pathlib import Path

import pytest
from audited import box_stl, findings_of, write_clean

AXLE = (0.048, 0.008, 0.008)
"""Size of an axle of 4.8 cm, m."""


def robot(folder: Path, *, mass: float, moment: float, scale: float = 1.0) -> list[dict[str, str]]:
    """Critical findings and warnings about a 4.8 cm axle on an arm of about 0.5 m."""
    (folder / "axle.stl").write_bytes(box_stl(AXLE))
    text = f"""<robot name="axle">
  <link name="world"/>
  <link name="arm"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="arm"/>
    <origin xyz="0 0 0.5"/></joint>
  <link name="axle">
    <inertial><mass value="{mass}"/>
      <inertia ixx="{moment}" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry>
      <mesh filename="axle.stl" scale="{scale} {scale} {scale}"/></geometry></collision>
  </link>
  <joint name="turn" type="revolute"><parent link="arm"/><child link="axle"/>
    <origin xyz="0.4 0 0"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="2"/></joint>
</robot>"""
    rows = findings_of(write_clean(folder, text))
    return [row for row in rows if row["severity"] in ("critical", "warning")]


def codes(rows: list[dict[str, str]]) -> set[str]:
    return {row["code"] for row in rows}


@pytest.mark.parametrize(("mass", "moment"), [(1.0, 1.0), (0.02, 0.1), (0.1, 100.0)])
def test_a_placeholder_inertia_is_reported_and_not_the_small_mesh(
    tmp_path: Path, mass: float, moment: float
) -> None:
    found = codes(robot(tmp_path, mass=mass, moment=moment))
    assert "inertia.too_large" in found
    assert "meshes.units" not in found


def test_a_tiny_inertia_is_reported_and_not_the_mesh(tmp_path: Path) -> None:
    found = codes(robot(tmp_path, mass=0.02, moment=1e-11))
    assert "inertia.too_small" in found
    assert "meshes.units" not in found


@pytest.mark.parametrize(("scale", "said"), [(1000.0, "far too large"), (0.001, "far too small")])
def test_a_mesh_in_another_unit_is_reported(tmp_path: Path, scale: float, said: str) -> None:
    rows = robot(tmp_path, mass=0.02, moment=4e-6, scale=scale)
    (mesh,) = [row for row in rows if row["code"] == "meshes.units"]
    assert mesh["severity"] == "critical"
    assert said in mesh["title"]


def test_a_mesh_in_millimetres_is_found_despite_a_placeholder_inertia(tmp_path: Path) -> None:
    # Mass and reach of the robot decide: an inertia of 1 kg*m^2 fits neither size.
    rows = robot(tmp_path, mass=0.02, moment=1.0, scale=1000.0)
    assert [row["severity"] for row in rows if row["code"] == "meshes.units"] == ["critical"]


def test_a_consistent_axle_has_no_finding(tmp_path: Path) -> None:
    found = codes(robot(tmp_path, mass=0.024, moment=4e-6))
    assert not found & {"meshes.units", "inertia.too_large", "inertia.too_small"}
