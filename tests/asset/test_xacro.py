"""Robots as xacro files: expanded in a confined child, with every file in the source chain."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
from asset_robots import stl
from in_process import InProcess
from test_supplier_chain import edit, keep_goldens, run_gate

from pytest_twin.cli import main
from pytest_twin.commands import xacro_files
from pytest_twin.errors import FormatError
from pytest_twin.gate import runner as gate_runner
from pytest_twin.realization import load, urdf
from pytest_twin.realization.confinement import why_not_confined

pytest.importorskip("xacro")

pytestmark = [
    pytest.mark.usefixtures("commands_in_process"),
    pytest.mark.skipif(why_not_confined() is not None, reason="this machine confines no process"),
]

NAMESPACE = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
ARM = f"""<robot name="arm" {NAMESPACE}>
  <xacro:arg name="mass" default="1.5"/>
  <xacro:include filename="$(find parts)/urdf/link.xacro"/>
  <xacro:property name="p" value="${{xacro.load_yaml('$(find arm_description)/config/p.yaml')}}"/>
  <xacro:part name="base" mass="$(arg mass)"/>
  <xacro:part name="l1" mass="${{p['mass'] * 2}}"/>
  <joint name="j1" type="revolute"><origin xyz="0.2 0 0" rpy="0 0 ${{pi / 2}}"/>
    <parent link="base"/><child link="l1"/><axis xyz="0 0 1"/>
    <limit lower="-1.5" upper="1.5" effort="10" velocity="2"/></joint>
</robot>
"""
PART = f"""<robot {NAMESPACE}>
  <xacro:macro name="part" params="name mass">
    <link name="${{name}}">
      <inertial><origin xyz="0.1 0 0"/><mass value="${{mass}}"/>
        <inertia ixx="0.002" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><origin xyz="0.1 0 0"/><geometry>
        <mesh filename="file://$(find arm_description)/meshes/a.stl"/></geometry></collision>
    </link>
  </xacro:macro>
</robot>
"""
XACRO = Path("arm_description/urdf/arm.urdf.xacro")


def supplied(folder: Path, arm: str = ARM) -> Path:
    """A delivery of two packages; returns its folder."""
    texts = {
        XACRO: arm,
        "arm_description/config/p.yaml": "mass: 0.7\n",
        "parts/urdf/link.xacro": PART,
        "arm_description/package.xml": "<package><name>arm_description</name></package>",
        "parts/package.xml": "<package><name>parts</name></package>",
    }
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (folder / "arm_description/meshes").mkdir()
    (folder / "arm_description/meshes/a.stl").write_bytes(stl())
    return folder


def options(folder: Path) -> list[str]:
    return ["--package", f"parts={folder / 'parts'}"]


@pytest.fixture(autouse=True)
def _no_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH"):
        monkeypatch.delenv(name, raising=False)


def test_realize_expands_with_arguments_and_records_every_file(tmp_path: Path) -> None:
    folder = supplied(tmp_path / "supplied")
    out = tmp_path / "out"

    status = main(
        ["realize", str(folder / XACRO), "--out", str(out), "--xacro", "mass:=2", *options(folder)]
    )

    assert status == 0
    robot = urdf.read(out / "arm.urdf")
    assert {name: link.mass for name, link in robot.links.items()} == {"base": 2.0, "l1": 1.4}
    states = json.loads((out / "manifest.json").read_text())["states"]
    made = states["normalized"]["made"]
    assert set(made["from"]["files"]) == {
        str(XACRO),
        "arm_description/config/p.yaml",
        "arm_description/meshes/a.stl",
        "parts/urdf/link.xacro",
    }
    assert made["command"][-2:] == ["--xacro", "mass:=2"]
    assert "xacro" in made["versions"]
    # The lines of the change log are of this file.
    expanded = (out / "arm.expanded.urdf").read_text()
    assert "xacro arm.urdf.xacro mass:=2 > arm.urdf" in expanded
    assert 'filename="package://arm_description/meshes/a.stl"' in expanded


def test_audit_reports_what_the_file_expands_to(tmp_path: Path) -> None:
    folder = supplied(tmp_path / "supplied", ARM.replace("0 0 1", "0 0 0"))

    status = main(["audit", str(folder / XACRO), "--out", str(tmp_path / "a"), *options(folder)])

    assert status == 1
    report = json.loads((tmp_path / "a/arm.urdf.xacro.audit.json").read_text())
    found = next(f for f in report["findings"] if f["severity"] == "critical")
    lines = (tmp_path / "a/arm.urdf.xacro.audit.expanded.urdf").read_text().splitlines()
    line = found["line"]
    assert 'axis xyz="0 0 0"' in lines[line - 1]


@pytest.fixture
def released(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A twin of a xacro file, by the way of the how-to, with its first release."""
    monkeypatch.setattr(gate_runner, "Sandbox", InProcess)
    for name in ("CONFIG", "STATE"):
        monkeypatch.setenv(f"XDG_{name}_HOME", str(tmp_path / "user"))
    folder = supplied(tmp_path / "supplied")
    arm, twin = tmp_path / "arm", tmp_path / "twin"
    assert main(["intake", str(folder), "--out", str(arm)]) == 0
    assert main(["realize", str(arm / "source" / XACRO), "--out", str(arm)]) == 0
    assert main(["init", str(arm / "arm.xml"), "--out", str(twin)]) == 0
    keep_goldens(twin, "fk")
    assert run_gate(twin).lines[-1].startswith("release 0001 signed")
    return twin


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("parts/urdf/link.xacro", b"0.002", b"0.003"),
        ("arm_description/config/p.yaml", b"0.7", b"0.8"),
        (str(XACRO), b"1.5", b"1.6"),
    ],
)
def test_one_byte_of_an_included_file_blocks_the_release(
    released: Path, file: str, old: bytes, new: bytes
) -> None:
    edit(released / "asset/arm/source" / file, old, new)

    lines = run_gate(released).lines

    assert any("no release" in line for line in lines), lines
    assert any(file in line for line in lines), lines


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<link name=\"${xacro.load_yaml('/etc/shadow')}\"/>", "xacro may not read a file"),
        ('<xacro:include filename="../../../secret.xacro"/>', "xacro may not read a file"),
        ('<link name="$(optenv TWIN_SECRET none)"/>', "depends on a variable of the environment"),
        ('<link name="$(arg size)"/>', "Undefined substitution argument size"),
        ('<link name="${length}"/>', "name 'length' is not defined"),
        ('<xacro:include filename="$(find nowhere)/a.xacro"/>', "--package nowhere=FOLDER"),
        ('<link name="a">', "mismatched tag"),
    ],
)
def test_a_file_that_cannot_be_expanded_is_refused_in_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    text: str,
    words: str,
) -> None:
    monkeypatch.setenv("TWIN_SECRET", "3")
    (tmp_path / "secret.xacro").write_text(f"<robot {NAMESPACE}><link name='a'/></robot>")
    folder = tmp_path / "robot/arm_description"
    (folder / "urdf").mkdir(parents=True)
    (folder / "package.xml").write_text("<package/>")
    path = folder / "urdf/arm.xacro"
    path.write_text(f'<robot name="arm" {NAMESPACE}>{text}</robot>')

    status = main(["audit", str(path), "--out", str(tmp_path / "a")])

    error = capsys.readouterr().err
    assert status == 2
    assert words in error
    assert error.count("\n") == 1


def test_an_argument_that_the_file_does_not_declare_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = supplied(tmp_path)

    status = main(
        [
            "audit",
            str(folder / XACRO),
            "--out",
            str(tmp_path),
            "--xacro",
            "mas:=2",
            *options(folder),
        ]
    )

    assert status == 2
    assert "--xacro: the file has no such argument (got 'mas'; expected mass)" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize("missing", ["xacro", "Landlock"])
def test_without_xacro_or_confinement_the_command_of_ros_is_given(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    missing: str,
) -> None:
    folder = supplied(tmp_path)
    if missing == "xacro":
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    else:
        monkeypatch.setattr(xacro_files, "why_not_confined", lambda: "no Landlock")

    status = main(
        ["realize", str(folder / XACRO), "--out", str(tmp_path / "o"), "--xacro", "mass:=2"]
    )

    error = capsys.readouterr().err
    assert status == 2
    assert "xacro arm.urdf.xacro mass:=2 > arm.urdf" in error
    assert missing in error or "pip install 'pytest-twin[xacro]'" in error


@pytest.fixture
def released_from_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A twin of a xacro file by one command, with its first release."""
    monkeypatch.setattr(gate_runner, "Sandbox", InProcess)
    for name in ("CONFIG", "STATE"):
        monkeypatch.setenv(f"XDG_{name}_HOME", str(tmp_path / "user"))
    folder, twin = supplied(tmp_path / "supplied"), tmp_path / "twin"
    (folder / "another").mkdir()
    (folder / "another/private.txt").write_text("not of this robot")
    words = ["init", str(folder / XACRO), "--xacro", "mass:=2", "--out", str(twin)]
    assert main([*words, *options(folder)]) == 0
    keep_goldens(twin, "fk")
    assert run_gate(twin).lines[-1].startswith("release 0001 signed")
    return twin


def test_init_takes_a_xacro_file_with_its_packages_into_the_source_chain(
    released_from_the_file: Path,
) -> None:
    asset = released_from_the_file / "asset/arm"
    assert urdf.read(asset / "arm.urdf").links["base"].mass == 2.0
    kept = {p.relative_to(asset / "source").parts[0] for p in (asset / "source").rglob("*")}
    assert kept == {"arm_description", "parts"}

    edit(asset / "source/parts/urdf/link.xacro", b"0.002", b"0.003")

    lines = run_gate(released_from_the_file).lines
    assert any("no release" in line for line in lines), lines
    assert any("parts/urdf/link.xacro" in line for line in lines), lines


def test_intake_copies_the_packages_of_a_xacro_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, arm = supplied(tmp_path / "supplied"), tmp_path / "arm"

    words = ["intake", str(folder / XACRO), "--out", str(arm), "--xacro", "mass:=2"]
    assert main([*words, *options(folder)]) == 0
    source = json.loads((arm / "manifest.json").read_text())["states"]["source"]
    assert "source/parts/urdf/link.xacro" in source["files"]
    assert "source/arm_description/meshes/a.stl" in source["files"]
    assert source["origin"]["name"] == "arm.urdf.xacro"
    (following,) = [
        line for line in capsys.readouterr().out.splitlines() if line.startswith("next: ")
    ]
    assert main([*following.split()[2:]]) == 0
    assert urdf.read(arm / "arm.urdf").links["base"].mass == 2.0


def test_a_failed_init_of_a_xacro_file_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = supplied(tmp_path / "supplied")
    words = ["init", str(folder / XACRO), "--out", str(tmp_path / "o"), "--xacro", "size:=2"]

    status = main([*words, *options(folder)])

    assert status == 2
    assert "--xacro: the file has no such argument" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_a_model_that_is_not_expanded_names_the_way_to_one(tmp_path: Path) -> None:
    path = supplied(tmp_path) / XACRO
    with pytest.raises(FormatError, match=r"pytest-twin realize arm\.urdf\.xacro --out DIR"):
        load(path)
