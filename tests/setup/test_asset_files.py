"""What `init` copies of a robot, and which roots it declares."""

from __future__ import annotations

from pathlib import Path

import pytest

from pytest_twin.errors import SpecError
from pytest_twin.setup.asset_files import RobotFiles, bring_in


def file(path: Path, text: str = "x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.fixture
def arm(tmp_path: Path) -> RobotFiles:
    root = tmp_path / "ws/arm"
    files = [file(root / "urdf/arm.urdf"), file(root / "meshes/a.stl")]
    return RobotFiles(files[0], files, root)


def test_a_copy_keeps_the_folders_below_the_root(arm: RobotFiles, tmp_path: Path) -> None:
    twin = tmp_path / "twin"
    brought = bring_in(arm, twin)
    assert brought.model == twin / "asset/arm/urdf/arm.urdf"
    assert brought.files == [brought.model, twin / "asset/arm/meshes/a.stl"]
    assert all(path.is_file() for path in brought.files)
    assert brought.roots == {"arm": twin / "asset/arm"}


def test_a_package_elsewhere_gets_a_folder_of_its_name(arm: RobotFiles, tmp_path: Path) -> None:
    mesh = file(tmp_path / "opt/share/visuals-2/b.stl")
    packages = {"visuals": mesh.parent, "arm_description": arm.root}
    robot = RobotFiles(arm.model, [*arm.files, mesh], arm.root, packages)
    twin = tmp_path / "twin"
    brought = bring_in(robot, twin)
    assert brought.files[2] == twin / "asset/visuals/b.stl"
    assert brought.roots == {
        "arm": twin / "asset/arm",
        "arm_description": twin / "asset/arm",
        "visuals": twin / "asset/visuals",
    }


def test_a_folder_that_relative_paths_lead_to_keeps_its_place(
    arm: RobotFiles, tmp_path: Path
) -> None:
    mesh = file(tmp_path / "ws/shared/b.stl")
    robot = RobotFiles(arm.model, [*arm.files, mesh], arm.root, others=[mesh.parent])
    brought = bring_in(robot, tmp_path / "twin")
    assert brought.model == tmp_path / "twin/asset/ws/arm/urdf/arm.urdf"
    assert brought.files[2] == tmp_path / "twin/asset/ws/shared/b.stl"


def test_a_file_that_is_named_absolutely_stays_and_is_declared(
    arm: RobotFiles, tmp_path: Path
) -> None:
    mesh = file(tmp_path / "elsewhere/b.stl")
    arm.model.write_text(f"<mesh filename='file://{mesh}'/>")
    robot = RobotFiles(arm.model, [*arm.files, mesh], arm.root, others=[mesh.parent])
    brought = bring_in(robot, tmp_path / "twin")
    assert brought.files[2] == mesh
    assert brought.roots["elsewhere"] == mesh.parent


def test_a_robot_in_the_folder_is_not_copied_and_its_root_is_declared(
    arm: RobotFiles, tmp_path: Path
) -> None:
    brought = bring_in(arm, tmp_path / "ws")
    assert brought.model == arm.model
    assert brought.roots == {"arm": arm.root}
    plain = RobotFiles(arm.model, [arm.model], arm.model.parent)
    assert bring_in(plain, tmp_path / "ws").roots == {}


def test_the_name_of_a_root_is_one_that_a_twin_can_state(tmp_path: Path) -> None:
    root = tmp_path / "my arm (v2)"
    model = file(root / "arm.urdf")
    assert list(bring_in(RobotFiles(model, [model], root), tmp_path / "t").roots) == ["my_arm__v2_"]


def test_an_asset_that_is_there_is_not_written_over(arm: RobotFiles, tmp_path: Path) -> None:
    bring_in(arm, tmp_path / "twin")
    with pytest.raises(SpecError, match="the asset's place is taken"):
        bring_in(arm, tmp_path / "twin")
