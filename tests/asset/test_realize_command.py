"""``pytest-twin realize`` on real robots."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from asset_robots import ARM, FINGER, PANDA, UR3, write_arm

from pytest_twin.cli import main
from pytest_twin.formats.digest import file_sha256

pytestmark = pytest.mark.usefixtures("commands_in_process")

LOAD = """
import sys, mujoco
model = mujoco.MjModel.from_xml_path(sys.argv[1])
print(model.nq, model.neq, model.nu, (model.geom_group == 2).sum())
"""


def rows(out: Path, target: str) -> dict[str, dict[str, object]]:
    matrix = json.loads((out / "loss.json").read_text())
    held = next(c for c in matrix["conversions"] if c["target"] == target)
    return {row["feature"]: row for row in held["rows"]}


def test_the_panda_is_realized_as_mjcf_that_plain_mujoco_loads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "panda"
    assert main(["realize", str(PANDA), "--out", str(out)]) == 0
    assert "URDF -> MJCF" in capsys.readouterr().out
    manifest = json.loads((out / "manifest.json").read_text())
    assert list(manifest["states"]) == ["source", "normalized", "realization"]
    for state in ("normalized", "realization"):
        for name, digest in manifest["states"][state]["files"].items():
            assert file_sha256(out / name) == digest
    assert {"panda.urdf", "panda.xml", "changes.md", "loss.html", "loss.md"} <= {
        path.name for path in out.iterdir()
    }
    # Plain MuJoCo loads it from another folder, without pytest_twin.
    loaded = subprocess.run(
        [sys.executable, "-c", LOAD, str(out / "panda.xml")],
        cwd="/", capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert loaded.stdout.split() == ["9", "1", "8", "11"]
    found = rows(out, "MJCF")
    for feature in ("forward kinematics, position", "forward kinematics, orientation"):
        assert found[feature]["difference"] < 1e-9
    assert found["mimic"]["verdict"] == "kept"


def test_usd_is_written_and_the_result_is_reproducible(tmp_path: Path) -> None:
    pytest.importorskip("urdf_usd_converter")
    out = tmp_path / "finger"
    assert main(["realize", str(FINGER), "--out", str(out)]) == 1
    assert (out / "finger_edu.usdc").is_file()
    assert rows(out, "USD")["forward kinematics, position"]["difference"] < 1e-9
    again = tmp_path / "again"
    assert main(["realize", str(FINGER), "--out", str(again)]) == 1
    first, second = ((folder / "manifest.json").read_text() for folder in (out, again))
    assert first == second


def test_if_openusd_does_not_load_the_other_forms_are_written(tmp_path: Path) -> None:
    # As with two OpenUSD packages in one environment: the module exists but does not load.
    (tmp_path / "broken/pxr").mkdir(parents=True)
    (tmp_path / "broken/pxr/__init__.py").write_text("raise ImportError('built apart')")
    out = tmp_path / "arm"
    urdf = write_arm(tmp_path)
    ran = subprocess.run(
        [sys.executable, "-m", "pytest_twin.cli", "realize", str(urdf), "--out", str(out)],
        env={**os.environ, "PYTHONPATH": str(tmp_path / "broken")},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert "USD is left out" in ran.stderr
    assert (out / "arm.xml").is_file()
    assert not list(out.glob("*.usd*"))
    usd = json.loads((out / "manifest.json").read_text())["states"]["realization"]["usd"]
    assert usd["file"] is None
    assert usd["left_out"].startswith("USD is left out")


def test_an_impossible_inertia_fails_until_its_repair_is_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    tube = 'ixx="0.02" iyy="0.02" izz="0.003" ixy="0.0002"'
    urdf = write_arm(tmp_path, ARM.replace(tube, 'ixx="1" iyy="0.1" izz="0.1"'))
    words = ["realize", str(urdf), "--out", str(out)]
    assert main(words) == 1
    stderr = capsys.readouterr().err
    assert "link 'upper'.inertia: no body can have it" in stderr
    assert stderr.count('to accept its repair: --accept "inertia-repair:upper"') == 1
    assert not (out / "arm.xml").exists()
    assert (out / "arm.urdf").is_file()
    assert main([*words, "--accept", "inertia-repair:upper"]) == 0
    assert (out / "arm.xml").is_file()
    log = json.loads((out / "changes.json").read_text())
    assert [c["patch"] for c in log["changes"] if c["patch"]] == ["inertia-repair:upper"]
    assert log["flags"] == []
    assert log["command"][-2:] == ["--accept", "inertia-repair:upper"]
    assert rows(out, "MJCF")["mass matrix"]["verdict"] == "kept"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: UR3, "ur3.urdf:6: robot: a robot without links"),
        (lambda folder: folder / "none.urdf", "no such file"),
        (lambda folder: _write_urdf(folder, "<robot"), "robot.urdf:1"),
        (lambda folder: _write_urdf(folder, "<!DOCTYPE a [<!ENTITY b 'c'>]><robot/>"), "DTD"),
        (
            lambda folder: _write_urdf(folder, "<robot><link name='a'/><link name='a'/></robot>"),
            "name",
        ),
    ],
)
def test_unusable_input_is_refused_with_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], make: object, words: str
) -> None:
    assert callable(make)
    assert main(["realize", str(make(tmp_path)), "--out", str(tmp_path / "out")]) == 2
    stderr = capsys.readouterr().err
    assert words in stderr
    assert len(stderr.strip().splitlines()) == 1
    assert not list((tmp_path / "out").glob("*")) or not (tmp_path / "out").exists()


def _write_urdf(folder: Path, text: str) -> Path:
    path = folder / "robot.urdf"
    path.write_text(text)
    return path


def test_old_results_are_removed_and_other_files_are_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    urdf = write_arm(tmp_path)
    assert main(["realize", str(urdf), "--out", str(out)]) == 0
    (out / "notes.txt").write_text("mine")
    moved = urdf.rename(urdf.with_name("other.urdf"))
    assert main(["realize", str(moved), "--out", str(out)]) == 0
    assert (out / "notes.txt").read_text() == "mine"
    assert not (out / "arm.urdf").exists()
    assert (out / "other.xml").is_file()


def test_a_robot_name_with_a_path_writes_no_file_outside_the_output(tmp_path: Path) -> None:
    folder = tmp_path / "a/b"
    folder.mkdir(parents=True)
    urdf = write_arm(folder, ARM.replace('name="arm"', 'name="../../../evil"', 1))
    before = set(tmp_path.rglob("*"))
    assert main(["realize", str(urdf), "--out", str(folder / "out")]) == 0
    made = set(tmp_path.rglob("*")) - before
    assert all(path.is_relative_to(folder / "out") for path in made)
    assert '<robot name="evil">' in (folder / "out/arm.urdf").read_text()


def test_the_asset_of_an_intake_is_not_replaced_by_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = write_arm(tmp_path)
    taken = tmp_path / "taken"
    assert main(["intake", str(urdf.parents[1]), "--out", str(taken)]) == 0
    before = (taken / "manifest.json").read_text()
    assert main(["realize", str(urdf), "--out", str(taken)]) == 2
    assert "the folder contains another asset" in capsys.readouterr().err
    assert (taken / "manifest.json").read_text() == before


def test_the_source_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = write_arm(tmp_path)
    before = urdf.read_bytes()
    assert main(["realize", str(urdf), "--out", str(urdf.parent)]) == 2
    assert "the source would be overwritten" in capsys.readouterr().err
    assert urdf.read_bytes() == before


@pytest.mark.parametrize("command", ["realize", "intake", "audit", "init"])
def test_an_output_path_that_is_a_file_is_refused_with_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    source = tmp_path / "source"
    source.mkdir()
    urdf = write_arm(source)
    (tmp_path / "file").write_text("kept")
    asset = source if command == "intake" else urdf
    for out in (tmp_path / "file", tmp_path / "file/below"):
        assert main([command, str(asset), "--out", str(out)]) == 2
        stderr = capsys.readouterr().err
        assert stderr.startswith(f"pytest-twin {command}: ")
        assert stderr.count("\n") == 1
        assert "is not a folder, or inside a file" in stderr
    assert (tmp_path / "file").read_text() == "kept"


def test_a_failed_result_contains_no_temporary_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tube = 'ixx="0.02" iyy="0.02" izz="0.003" ixy="0.0002"'
    urdf = write_arm(tmp_path, ARM.replace(tube, 'ixx="1" iyy="0.1" izz="0.1"'))
    made = []
    for name in ("first", "second"):
        out = tmp_path / name
        assert main(["realize", str(urdf), "--out", str(out)]) == 1
        assert ".twin-" not in capsys.readouterr().err
        made.append({p.name: p.read_bytes() for p in out.rglob("*") if p.is_file()})
        assert not [n for n, data in made[-1].items() if b".twin-" in data]
    assert b"URDF -> MJCF: arm.urdf:" in made[0]["loss.json"]
    assert made[0] == made[1]


def test_a_principal_moment_of_zero_fails_with_the_message_of_the_audit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "finger"
    assert main(["realize", str(FINGER), "--out", str(out)]) == 1
    flags = json.loads((out / "changes.json").read_text())["flags"]
    assert [(flag["where"], flag["line"]) for flag in flags] == [
        ("link 'finger_lower_link'.inertia", 167)
    ]
    assert flags[0]["value"].startswith("principal moments 0, ")
    assert capsys.readouterr().err == (
        "FAILS: finger_edu.urdf:127: link 'finger_lower_link': a principal moment of its inertia "
        "is zero: it is not positive definite\n"
    )
    assert not flags[0]["critical"]


def test_the_logged_command_includes_the_packages(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    out = tmp_path / "out"
    words = ["realize", str(urdf), "--out", str(out), "--package", f"arm_meshes={tmp_path}"]
    assert main(words) == 0
    command = json.loads((out / "changes.json").read_text())["command"]
    assert command[-2:] == ["--package", "arm_meshes=FOLDER"]


@pytest.mark.parametrize(("role", "audited", "realized"), [("visual", 0, 0), ("collision", 1, 2)])
def test_audit_and_realize_pass_without_a_visual_and_fail_without_a_collision_mesh(
    tmp_path: Path, role: str, audited: int, realized: int
) -> None:
    shape = f'<{role}><geometry><mesh filename="nope.stl"/></geometry></{role}>'
    urdf = write_arm(
        tmp_path, ARM.replace("</link>", f"{shape}</link>", 1).replace("0 2 1", "0 0 1")
    )
    out = str(tmp_path / "out")
    assert main(["audit", str(urdf), "--out", out]) == audited
    assert main(["realize", str(urdf), "--out", out]) == realized
