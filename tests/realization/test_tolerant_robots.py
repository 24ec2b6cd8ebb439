"""Robot files that violate a standard but that MuJoCo or Pinocchio loads."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pytest_twin.asset.realize import realize
from pytest_twin.audit.audit_file import audit_file
from pytest_twin.errors import FormatError, LimitError, TwinError
from pytest_twin.realization import load

INERTIAL = (
    '<inertial><mass value="1"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
)
URDF = """<robot name="arm"{attributes}>
  <link name="a">{inertial}{shape}</link>
  <link name="b">{inertial}</link>
  <link name="c">{inertial}</link>
  <joint name="j" type="{kind}"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
    {limit}</joint>
  <joint name="k" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="5" velocity="1"/>{mimic}</joint>
  {more}
</robot>
"""
LIMIT = '<limit lower="-2" upper="2" effort="40" velocity="2"/>'


def robot(folder: Path, **changed: str) -> Path:
    words = {"kind": "revolute", "limit": LIMIT, "inertial": INERTIAL}
    words |= dict.fromkeys(("attributes", "shape", "mimic", "more"), "")
    path = folder / "arm.urdf"
    path.write_text(URDF.format(**{**words, **changed}))
    return path


def realized(path: Path, folder: Path) -> dict[str, object]:
    folder.mkdir()
    return realize(str(path), str(folder))


@pytest.mark.parametrize("declared", [' xmlns:drake="http://drake.mit.edu"', ""])
@pytest.mark.parametrize(
    "changed",
    [
        {"limit": '<limit drake:acceleration="15" lower="-2" upper="2" effort="4" velocity="2"/>'},
        {"more": '<drake:collision_filter_group name="w"><drake:member link="a"/>'
                 "</drake:collision_filter_group>"},
        {"more": '<xacro:property name="x" value="1"/>'},
        {"more": "<gazebo:plugin/>"},
    ],
)  # fmt: skip
def test_elements_with_a_namespace_prefix_are_kept_and_reported(
    tmp_path: Path, declared: str, changed: dict[str, str]
) -> None:
    path = robot(tmp_path, attributes=declared, **changed)
    assert load(path).joints == ("j", "k")
    made = realized(path, tmp_path / "made")
    assert made["critical"] == []
    found = audit_file(str(path))
    assert found["verdict"] == "warnings"
    custom = [row for row in found["findings"] if row["code"] == "controllers.custom_tag"]
    assert any(":" in row["element"] for row in custom)
    prefix = custom[0]["element"].partition(":")[0].rpartition("@")[2]
    codes = [row["code"] for row in found["findings"]]
    assert ("tree.not_well_formed" in codes) == (f"xmlns:{prefix}" not in declared)


@pytest.mark.parametrize("value", ["$(arg meshes)/a.stl", "${side}/a.stl", "$(env HOME)/a.stl"])
def test_a_part_of_a_xacro_file_is_refused(tmp_path: Path, value: str) -> None:
    path = tmp_path / "tool.urdf"
    path.write_text(
        '<robot name="tool"><link name="a"><visual><geometry>\n'
        f'<mesh filename="{value}"/></geometry></visual></link></robot>'
    )
    with pytest.raises(TwinError, match=r"tool\.urdf:2: .*substitution of xacro.*includes this"):
        load(path)


def test_an_unexpanded_xacro_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.urdf"
    path.write_text('<robot name="a"><xacro:include filename="b.xacro"/></robot>')
    with pytest.raises(TwinError, match=r"a\.urdf:1: .*a xacro macro.*the output of `xacro`"):
        load(path)


def test_double_hyphens_in_comments_are_reported_with_their_line(tmp_path: Path) -> None:
    path = robot(tmp_path, more="<!-- ---- tool ---- -->\n<!-- a --->")
    assert load(path).joints == ("j", "k")
    rows = audit_file(str(path))["findings"]
    lines = {row["line"] for row in rows if row["code"] == "tree.not_well_formed"}
    assert lines == {9, 10}
    assert realized(path, tmp_path / "made")["critical"] == []


@pytest.mark.parametrize(
    "text",
    [
        "<robot><link></robot>",
        '<robot a="1" a="2"/>',
        '<robot a="x & y"/>',
        "<robot><!-- a -- b --></robot><robot/>",
        "<robot><x:a></robot>",
        "<robot><!-- -- never ends </robot>",
    ],
)
def test_xml_with_ambiguous_elements_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.urdf"
    path.write_text(text)
    with pytest.raises(FormatError, match="not well-formed XML"):
        load(path)


def test_a_mimic_of_a_fixed_joint_is_held_at_its_offset(tmp_path: Path) -> None:
    path = robot(tmp_path, kind="fixed", mimic='<mimic joint="j" multiplier="1" offset="0.1"/>')
    realization = load(path)
    model = realization.model
    assert model.neq == 1
    assert model.eq_data[0, 0] == pytest.approx(0.1)
    assert model.eq_obj2id[0] == -1
    assert any("holds it at its offset, 0.1" in note for note in realization.notes)
    said = realized(path, tmp_path / "made")["critical"]
    assert said == []


def test_a_mimic_of_a_missing_joint_is_dropped_and_critical(tmp_path: Path) -> None:
    path = robot(tmp_path, mimic='<mimic joint="nowhere"/>')
    assert load(path).model.neq == 0
    made = realized(path, tmp_path / "made")
    assert made["critical"] == ["joint 'k'.mimic: it follows a joint that does not exist (nowhere)"]
    assert audit_file(str(path))["verdict"] == "critical"


@pytest.mark.parametrize(
    "limit", ["", '<limit lower="-1" upper="1"/>', '<limit effort="3"/>', '<limit velocity="3"/>']
)
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_limits_required_by_urdfdom_are_added_and_logged(
    tmp_path: Path, kind: str, limit: str
) -> None:
    path = robot(tmp_path, kind=kind, limit=limit)
    made = realized(path, tmp_path / "made")
    assert made["critical"] == []
    changes = json.loads((tmp_path / "made/changes.json").read_text())["changes"]
    added = [change["where"] for change in changes if "urdfdom" in change["why"]]
    lacking = [key for key in ("effort", "velocity") if f"{key}=" not in limit]
    assert added == [f"joint 'j'.limit.{key}" for key in lacking]
    assert load(path).reference.joints == ("j", "k")


# -- meshes


def box() -> trimesh.Trimesh:
    return trimesh.creation.box((0.2, 0.4, 0.6))


def exported(folder: Path, name: str) -> Path:
    path = folder / name
    if path.suffix == ".gltf":
        for file, data in trimesh.Scene(box()).export(file_type="gltf").items():
            (folder / (name if file.endswith(".gltf") else file)).write_bytes(data)
    elif path.suffix == ".glb":
        path.write_bytes(trimesh.Scene(box()).export(file_type="glb"))
    else:
        box().export(path)
    return path


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".ply"])
def test_gltf_and_ply_meshes_are_read_and_converted(tmp_path: Path, suffix: str) -> None:
    exported(tmp_path, f"w{suffix}")
    mesh = f'<geometry><mesh filename="w{suffix}"/></geometry>'
    path = robot(
        tmp_path, shape=f"<collision>{mesh}</collision><visual>{mesh}</visual>"
    )  # fmt: skip
    model = load(path).model
    size = np.ptp(model.mesh_vert, axis=0)
    assert sorted(size) == pytest.approx([0.2, 0.4, 0.6], abs=1e-6)
    files = {file.suffix for file in load(path).source.files}
    assert (".bin" in files) == (suffix == ".gltf")
    made = realized(path, tmp_path / "made")
    assert made["critical"] == []
    assert (tmp_path / "made/meshes/w.obj").is_file()
    assert audit_file(str(path))["verdict"] == "warnings"


def glb(document: dict[str, object]) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON")
    return head + text


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ({"accessors": [{"count": 10**12}]}, "too many triangles"),
        ({"nodes": [{"children": [1, 2]}, {"children": [2]}, {}]}, "a node with two parents"),
        (
            {
                "accessors": [{"count": 3_000_000}],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
                "nodes": [{"mesh": 0}] * 9,
            },
            "too many triangles",
        ),
        ({"nodes": [{}] * 20_000}, "too many nodes"),
        ({"meshes": [{"primitives": [{"attributes": {}}]}]}, "broken"),
        ({"buffers": [{"uri": "../../../etc/hosts", "byteLength": 4}]}, "leaves|no such file"),
    ],
)
def test_a_malicious_gltf_is_refused_before_it_is_unpacked(
    tmp_path: Path, document: dict[str, object], words: str
) -> None:
    (tmp_path / "w.glb").write_bytes(glb(document))
    shape = '<collision><geometry><mesh filename="w.glb"/></geometry></collision>'
    with pytest.raises((FormatError, LimitError, TwinError), match=words):
        load(robot(tmp_path, shape=shape))
