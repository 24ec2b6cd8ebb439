"""``pytest-twin audit``: exit status, written files, messages and malicious input."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from audited import CLEAN, changed, line_of, write_clean

from pytest_twin.audit.audit_file import audit_file
from pytest_twin.cli import main
from pytest_twin.errors import TwinError
from pytest_twin.formats.declared_inputs import DeclaredInputs, declaring
from pytest_twin.report.audit import table

pytestmark = pytest.mark.usefixtures("commands_in_process")

BROKEN = changed(
    (
        '<inertia ixx="0.0012" iyy="0.0156" izz="0.0156" ixy="0" ixz="0" iyz="0"/>',
        '<inertia ixx="1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>',
    )
)


def test_a_clean_robot_exits_with_0_and_writes_json_and_html(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_clean(tmp_path)
    assert main(["audit", str(path), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "clean: 0 critical, 0 warning" in said.splitlines()[0]
    assert "commands.unknown (3)" in said
    rows = [line.split() for line in said.splitlines()]
    assert ["critical", "warning", "unknown", "info"] in rows
    assert ["inertia", "-", "-", "-", "-"] in rows
    assert ["commands", "-", "-", "3", "-"] in rows
    found = json.loads((tmp_path / "out/robot.urdf.audit.json").read_text())
    assert found["schema"] == 1
    assert found["verdict"] == "clean"
    assert found["facts"]["degrees_of_freedom"] == 4
    assert found["facts"]["independent"] == 3
    assert found["facts"]["mass"] == {"value": pytest.approx(3.51), "unit": "kg"}
    assert set(found["findings"][0]) == {
        "id",
        "code",
        "layer",
        "severity",
        "file",
        "line",
        "element",
        "title",
        "value",
        "unit",
        "expected",
        "why",
        "settle",
    }
    assert found["poses"][0]["pose"] == "zeros, within the ranges"
    assert found["meshes"][0]["watertight"] is True
    upper = next(row for row in found["bodies"] if row["body"] == "upper")
    # A bar of 2 kg and 0.3 x 0.06 x 0.06 m with its exact moments of inertia.
    assert upper["hull_density"] == {"value": pytest.approx(2 / 0.00108), "unit": "kg/m^3"}
    assert upper["uniform_moments"]["value"] == pytest.approx([0.0012, 0.0156, 0.0156])
    assert upper["principal_moments"]["value"] == pytest.approx([0.0012, 0.0156, 0.0156])
    page = (tmp_path / "out/robot.urdf.audit.html").read_text()
    assert "data:image/png;base64," in page
    # The page is self-contained: it loads no resources and runs no script.
    assert "<script" not in page
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)


def test_a_critical_finding_exits_with_1_and_is_printed_in_full(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_clean(tmp_path, BROKEN)
    assert main(["audit", str(path), "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert "CRITICAL: 1 critical" in said
    assert "X inertia.triangle: link 'upper': its principal moments break the triangle" in said
    line = line_of(BROKEN, "<inertial>")
    assert f"robot.urdf:{line}; got 0.1, 0.1, 1 kg*m^2; expected no moment above the sum" in said
    assert "next: " in said


def test_a_symbolic_link_to_the_robot_file_is_followed(tmp_path: Path) -> None:
    write_clean(tmp_path)
    link = tmp_path / "link.urdf"
    link.symlink_to(tmp_path / "robot.urdf")
    assert main(["audit", str(link), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/link.urdf.audit.json").exists()


def test_evidence_that_contradicts_the_file_is_a_critical_finding(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_clean(tmp_path)
    evidence = tmp_path / "evidence.yaml"
    evidence.write_text(
        "source: manual rev 3\njoints:\n  elbow:\n    positive: {frame: tcp, along: [0, -1, 0]}\n"
    )
    status = main(["audit", str(path), "--out", str(tmp_path), "--evidence", str(evidence)])
    said = capsys.readouterr().out
    assert status == 1
    assert "joints.sign_contradicted: joint 'elbow'" in said
    assert "as declared by manual rev 3" in said


def test_an_invalid_evidence_file_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_clean(tmp_path)
    evidence = tmp_path / "evidence.yaml"
    evidence.write_text("joints:\n  elbow: {rnage: [0, 1]}\n")
    assert main(["audit", str(path), "--evidence", str(evidence)]) == 2
    said = capsys.readouterr().err
    assert re.search(r"evidence\.yaml:2.*rnage", said)


BOMB = """<?xml version="1.0"?>
<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>
<robot name="&b;"><link name="a"/></robot>
"""

UNUSABLE = [
    ("bomb.urdf", BOMB, r"bomb\.urdf:2.*document type"),
    ("external.urdf", BOMB.replace('"aaaaaaaaaa"', 'SYSTEM "file:///etc/passwd"'), "document type"),
    ("empty.urdf", "", r"empty\.urdf:1: empty file"),
    ("cut.urdf", CLEAN[:700], r"cut\.urdf:\d+.*not well-formed"),
    ("other.urdf", "<svg/>", r"other\.urdf:1: not a robot model.*expected <robot> or <mujoco>"),
    ("bare.urdf", "<robot name='x'/>", "a robot without links"),
    (
        "macro.urdf",
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="m">'
        '<link name="a"/></xacro:macro></robot>',
        "a xacro macro, not a URDF",
    ),
    (
        "include.urdf",
        '<robot xmlns:xi="http://www.w3.org/2001/XInclude"><xi:include href="/etc/hosts"/></robot>',
        "an XInclude",
    ),
    (
        "deep.urdf",
        "<robot>" + "<a>" * 5000 + "</a>" * 5000 + "</robot>",
        r"deep\.urdf.*(deep|depth)",
    ),
    (
        "many.urdf",
        "<robot><link name='a'/>" + "<b/>" * 120_000 + "</robot>",
        r"many\.urdf.*too many elements",
    ),
    ("schema.xml", "<mujoco><foo/></mujoco>", r"schema\.xml:1.*unrecognized element"),
    (
        "loop.xml",
        '<mujoco><include file="loop.xml"/></mujoco>',
        r"loop\.xml",
    ),
    ("stage.usda", "#usda 1.0\ndef {{{", r"stage\.usda.*not a USD"),
    ("stage.usdc", "PXR-USDC" + "\0" * 200, r"stage\.usdc.*not a USD"),
    (
        "escape.usda",
        '#usda 1.0\n(subLayers = [@../../../../../../etc/passwd@])\ndef Xform "a" {}\n',
        r"escape\.usda.*leaves the declared roots",
    ),
    ("bodies.usda", '#usda 1.0\ndef Xform "a" {\n}\n', "a stage without a rigid body"),
]


@pytest.mark.parametrize(
    ("name", "text", "words"), UNUSABLE, ids=[case[0].replace(".", "_") for case in UNUSABLE]
)
def test_an_unusable_robot_file_is_a_one_line_error(
    tmp_path: Path, name: str, text: str, words: str
) -> None:
    if name.endswith((".usda", ".usdc")):
        pytest.importorskip("pxr")
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(TwinError) as caught:
        audit_file(str(path))
    assert re.search(words, str(caught.value)), str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_unusable_input_exits_with_2_and_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bomb.urdf"
    path.write_text(BOMB)
    assert main(["audit", str(path), "--out", str(tmp_path / "out")]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "bomb.urdf:2:17: a document type (DTD)" in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["missing.urdf", "."])
def test_a_missing_file_or_a_folder_exits_with_2_and_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert main(["audit", str(tmp_path / name)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_names_in_the_file_cannot_inject_escape_sequences_or_html(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evil = "&#x9;&lt;script&gt;alert(1)&lt;/script&gt;\u202e\u009b31m"
    path = write_clean(tmp_path, changed(('<robot name="clean">', f'<robot name="{evil}">')))
    text = path.read_text().replace('name="elbow"', f'name="{evil}"')
    path.write_text(text)
    assert main(["audit", str(path), "--out", str(tmp_path), "--all"]) == 0
    said = capsys.readouterr().out
    assert "script" in said
    assert all(char.isprintable() or char == "\n" for char in said)
    page = (tmp_path / "robot.urdf.audit.html").read_text()
    assert "<script" not in page
    assert "&lt;script&gt;" in page


def test_a_robot_with_5000_mimic_joints_is_audited_with_a_short_report(tmp_path: Path) -> None:
    # A long chain of links whose joints mimic each other in a loop.
    count = 5_000
    lines = ["<robot name='long'>", "<link name='l0'/>"]
    for at in range(1, count):
        lines.append(f"<link name='l{at}'/>")
        lines.append(
            f"<joint name='j{at}' type='continuous'><parent link='l{at - 1}'/><child link='l{at}'/>"
            f"<axis xyz='0 0 1'/><mimic joint='j{at + 1 if at < count - 1 else 1}'/></joint>"
        )
    path = tmp_path / "long.urdf"
    path.write_text("\n".join([*lines, "</robot>"]))
    said = table(audit_file(str(path)))
    assert "X coupling.mimic_loop: joint 'j1': joints follow each other in a loop" in said
    assert "X inertia.moving_without" in said
    assert len(said.splitlines()) < 80


def test_a_package_folder_can_be_given(tmp_path: Path) -> None:
    text = changed(('filename="bar.stl"', 'filename="package://arm_meshes/bar.stl"'))
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    write_clean(folder)
    (tmp_path / "robot").mkdir()
    path = tmp_path / "robot/robot.urdf"
    path.write_text(text)
    lost = audit_file(str(path))
    assert [row["code"] for row in lost["findings"][:1]] == ["meshes.missing"]
    assert "package 'arm_meshes' is not found" in lost["findings"][0]["title"]
    with declaring(DeclaredInputs(packages={"arm_meshes": folder})):
        found = audit_file(str(path))
    assert found["counts"]["critical"] == 0
    assert found["meshes"][0]["file"] == str(folder / "bar.stl")


def test_a_closed_output_pipe_causes_no_traceback(tmp_path: Path) -> None:
    path = write_clean(tmp_path)
    command = f"{sys.executable} -m pytest_twin.cli audit {path} --out {tmp_path} --all | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert (tmp_path / "robot.urdf.audit.json").exists()


def test_a_file_instead_of_the_output_folder_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_clean(tmp_path)
    assert main(["audit", str(path), "--out", str(tmp_path / "bar.stl")]) == 2
    assert "bar.stl: is not a folder, or inside a file" in capsys.readouterr().err
