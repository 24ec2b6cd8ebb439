"""Faults that simulators ignore: limits, soft limits, up axes, visual meshes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from audited import changed, findings_of, line_of, only, write_clean

from pytest_twin.asset.realize import realize

LIMIT = '<limit lower="-1.5" upper="1.5" velocity="2" effort="50"/>'
SHOULDER = '<joint name="shoulder" type="revolute">'
DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit meter="1"/>{up}</asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array id="f" count="12">0 0 0 0.2 0 0 0 0.05 0 0 0 0.05</float_array>
      <technique_common><accessor source="#f" count="4" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
      <p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node>
    </visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""


def safety(text: str) -> list[tuple[str, str]]:
    return [(LIMIT, f"{LIMIT}<safety_controller {text}/>")]


def codes(folder: Path, *pairs: tuple[str, str]) -> dict[str, str]:
    rows = findings_of(write_clean(folder, changed(*pairs)))
    return {row["code"]: row["severity"] for row in rows if row["severity"] != "unknown"}


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_joint_without_limit_is_a_finding_with_the_element_to_add(
    tmp_path: Path, kind: str
) -> None:
    text = changed((LIMIT, ""), (SHOULDER, SHOULDER.replace("revolute", kind)))
    (found,) = only(findings_of(write_clean(tmp_path, text)), "joints.no_limit")
    assert (found["severity"], found["element"]) == ("warning", "joint 'shoulder'")
    assert found["line"] == line_of(text, '<joint name="shoulder"')
    assert found["title"] == f"a {kind} joint without <limit>"
    assert found["expected"] == '<limit lower="..." upper="..." effort="..." velocity="..."/>'
    assert not only(findings_of(write_clean(tmp_path, text)), "joints.no_range")


@pytest.mark.parametrize("kind", ["continuous", "fixed"])
def test_continuous_and_fixed_joints_need_no_limit(tmp_path: Path, kind: str) -> None:
    found = codes(tmp_path, (LIMIT, ""), (SHOULDER, SHOULDER.replace("revolute", kind)))
    assert "joints.no_limit" not in found


def test_a_range_of_a_continuous_joint_is_a_finding_and_a_loss(tmp_path: Path) -> None:
    text = changed((SHOULDER, SHOULDER.replace("revolute", "continuous")))
    path = write_clean(tmp_path, text)
    (found,) = only(findings_of(path), "joints.continuous_range")
    assert (found["severity"], found["value"], found["unit"]) == ("warning", "-1.5 .. 1.5", "rad")
    out = tmp_path / "out"
    out.mkdir()
    realize(str(path), str(out))
    (mjcf, *_) = json.loads((out / "loss.json").read_text())["conversions"]
    (row,) = [row for row in mjcf["rows"] if row["feature"] == "ranges of continuous joints"]
    assert row["verdict"] == "lost"
    assert row["items"][0]["name"] == "shoulder"
    assert row["items"][0]["before"] == "lower=-1.5 rad upper=1.5 rad"


def test_a_continuous_joint_with_velocity_and_effort_limits_is_accepted(
    tmp_path: Path,
) -> None:
    found = codes(
        tmp_path,
        (SHOULDER, SHOULDER.replace("revolute", "continuous")),
        (LIMIT, '<limit velocity="2" effort="50"/>'),
    )
    assert "joints.continuous_range" not in found


@pytest.mark.parametrize(
    "text",
    ['k_velocity="5"', 'k_velocity="5" soft_lower_limit="0.2" soft_upper_limit="0.2"'],
)
def test_empty_soft_limit_ranges_are_a_warning(tmp_path: Path, text: str) -> None:
    found = codes(tmp_path, *safety(text))
    assert found["controllers.soft_limits_empty"] == "warning"
    assert "controllers.soft_gain" not in found


def test_a_soft_limit_gain_of_zero_is_a_separate_warning(tmp_path: Path) -> None:
    found = codes(tmp_path, *safety('k_velocity="0" soft_lower_limit="-1" soft_upper_limit="1"'))
    assert found["controllers.soft_gain"] == "warning"
    assert "controllers.soft_limits_empty" not in found


def test_a_continuous_joint_needs_no_soft_limits(tmp_path: Path) -> None:
    found = codes(
        tmp_path,
        (SHOULDER, SHOULDER.replace("revolute", "continuous")),
        (LIMIT, '<limit velocity="2" effort="50"/><safety_controller k_velocity="10"/>'),
    )
    assert not [code for code in found if code.startswith("controllers.soft")]


@pytest.mark.parametrize(
    ("up", "said"),
    [
        ("<up_axis>Y_UP</up_axis>", "it states Y_UP"),
        ("<up_axis>X_UP</up_axis>", "it states X_UP"),
        ("", "it states no up_axis: Y_UP by default"),
        ("<up_axis>Z_UP</up_axis>", None),
    ],
)
def test_a_collada_mesh_that_is_not_z_up_is_a_warning(
    tmp_path: Path, up: str, said: str | None
) -> None:
    (tmp_path / "bar.dae").write_text(DAE.format(up=up))
    path = write_clean(tmp_path, changed(('filename="bar.stl"', 'filename="bar.dae"')))
    found = only(findings_of(path), "meshes.up_axis")
    assert [(row["title"], row["severity"]) for row in found] == (
        [(said, "warning")] if said else []
    )


@pytest.mark.parametrize("uri", ["model://arm/m/w.stl", "https://arm/w.stl", "../../outside.stl"])
def test_an_unusable_visual_mesh_is_only_a_warning(tmp_path: Path, uri: str) -> None:
    box = '<visual><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.06 0.06"/>'
    mesh = f'<visual><origin xyz="0.15 0 0"/><geometry><mesh filename="{uri}"/>'
    rows = findings_of(write_clean(tmp_path, changed((box, mesh))))
    assert [row["code"] for row in rows if row["severity"] == "critical"] == []
    assert [row["severity"] for row in rows if row["element"] == "visual of link 'upper'"] == [
        "warning"
    ]


def test_a_mimic_of_a_fixed_joint_is_a_warning_with_its_offset(tmp_path: Path) -> None:
    mimic = '<mimic joint="grip" multiplier="1"/>'
    text = changed((mimic, '<mimic joint="tcp_mount" multiplier="1" offset="0.01"/>'))
    path = write_clean(tmp_path, text)
    (found,) = only(findings_of(path), "coupling.mimic_master")
    assert found["severity"] == "warning"
    assert found["title"] == "it follows a fixed joint: it does not move from its offset, 0.01"
    out = tmp_path / "out"
    out.mkdir()
    assert realize(str(path), str(out))["critical"] == []
