"""A workspace built with `colcon build --symlink-install`: installed files are links to sources."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from asset_robots import ROBOTS
from test_xacro import XACRO, supplied

from pytest_twin.cli import main
from pytest_twin.realization.confinement import why_not_confined

pytestmark = pytest.mark.usefixtures("commands_in_process")

UR5 = Path("robots/ur_description/urdf/ur5_robot.urdf")


def install_by_links(source: Path, workspace: Path) -> Path:
    """Install a package as colcon does; returns its installed folder."""
    installed = workspace / "install" / source.name / "share" / source.name
    for file in source.rglob("*"):
        if file.is_file():
            link = installed / file.relative_to(source)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(file)
    return installed


@pytest.fixture
def ur5(tmp_path: Path) -> Path:
    """The installed package of a UR5."""
    source = tmp_path / "ws/src/example-robot-data"
    shutil.copytree(
        ROBOTS / "ur_description/meshes/ur5", source / "robots/ur_description/meshes/ur5"
    )
    (source / UR5).parent.mkdir(parents=True)
    shutil.copy(ROBOTS.parent / UR5, source / UR5)
    (source / "package.xml").write_text("<package><name>example-robot-data</name></package>")
    return install_by_links(source, tmp_path / "ws")


def test_a_robot_behind_links_gives_the_same_forms_as_the_robot_itself(
    tmp_path: Path, ur5: Path
) -> None:
    source = tmp_path / "ws/src/example-robot-data" / UR5
    for urdf, out in ((ur5 / UR5, "linked"), (source, "itself")):
        assert main(["realize", str(urdf), "--out", str(tmp_path / out)]) == 0

    linked, itself = (
        json.loads((tmp_path / out / "manifest.json").read_text())["states"]["normalized"]["files"]
        for out in ("linked", "itself")
    )
    assert linked == itself


def test_paths_of_another_machine_end_in_the_installed_package(
    tmp_path: Path,
    ur5: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = (ur5 / UR5).read_text()
    foreign = "file:///home/ana/ws/install/example-robot-data/share/example-robot-data"
    urdf = tmp_path / "exported" / "ur5.urdf"
    urdf.parent.mkdir()
    urdf.write_text(text.replace("package://example-robot-data", foreign))
    assert foreign in urdf.read_text()
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(ur5.parent.parent))

    status = main(["audit", str(urdf), "--out", str(tmp_path / "a")])

    assert status == 0
    out = capsys.readouterr().out
    assert "share/example-robot-data is taken for package 'example-robot-data'" in out
    report = json.loads((tmp_path / "a/ur5.urdf.audit.json").read_text())
    assert not [f for f in report["findings"] if f["code"].startswith("meshes.unreadable")]


@pytest.mark.skipif(why_not_confined() is not None, reason="this machine confines no process")
def test_a_xacro_file_behind_links_includes_files_behind_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("xacro")
    sources = supplied(tmp_path / "ws/src")
    prefixes = [
        install_by_links(sources / name, tmp_path / "ws") for name in ("arm_description", "parts")
    ]
    monkeypatch.setenv("AMENT_PREFIX_PATH", ":".join(str(p.parent.parent) for p in prefixes))
    xacro = prefixes[0] / XACRO.relative_to("arm_description")

    assert main(["realize", str(xacro), "--out", str(tmp_path / "out")]) == 0

    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert "src/parts/urdf/link.xacro" in manifest["states"]["source"]["files"]
