"""Which files `init` copies into the twin's folder, and which roots it declares."""

from __future__ import annotations

from pathlib import Path

import pytest

from pytest_twin.errors import SpecError
from pytest_twin.setup.asset_files import RobotFiles, copy_into_twin


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
    copied = copy_into_twin(arm, twin)
    assert copied.model == twin / "asset/arm/urdf/arm.urdf"
    assert copied.files == [copied.model, twin / "asset/arm/meshes/a.stl"]
    assert all(path.is_file() for path in copied.files)
    assert copied.roots == {"arm": twin / "asset/arm"}


def test_a_package_outside_the_root_is_copied_into_a_folder_with_its_name(
    arm: RobotFiles, tmp_path: Path
) -> None:
    mesh = file(tmp_path / "opt/share/visuals-2/b.stl")
    packages = {"visuals": mesh.parent, "arm_description": arm.root}
    robot = RobotFiles(arm.model, [*arm.files, mesh], arm.root, packages)
    twin = tmp_path / "twin"
    copied = copy_into_twin(robot, twin)
    assert copied.files[2] == twin / "asset/visuals/b.stl"
    assert copied.roots == {
        "arm": twin / "asset/arm",
        "arm_description": twin / "asset/arm",
        "visuals": twin / "asset/visuals",
    }


def test_a_folder_referenced_by_a_relative_path_keeps_its_relative_position(
    arm: RobotFiles, tmp_path: Path
) -> None:
    mesh = file(tmp_path / "ws/shared/b.stl")
    robot = RobotFiles(arm.model, [*arm.files, mesh], arm.root, others=[mesh.parent])
    copied = copy_into_twin(robot, tmp_path / "twin")
    assert copied.model == tmp_path / "twin/asset/ws/arm/urdf/arm.urdf"
    assert copied.files[2] == tmp_path / "twin/asset/ws/shared/b.stl"


def test_a_file_with_an_absolute_path_is_not_copied_and_its_folder_is_declared(
    arm: RobotFiles, tmp_path: Path
) -> None:
    mesh = file(tmp_path / "elsewhere/b.stl")
    arm.model.write_text(f"<mesh filename='file://{mesh}'/>")
    robot = RobotFiles(arm.model, [*arm.files, mesh], arm.root, others=[mesh.parent])
    copied = copy_into_twin(robot, tmp_path / "twin")
    assert copied.files[2] == mesh
    assert copied.roots["elsewhere"] == mesh.parent


def test_a_robot_inside_the_twin_is_not_copied_and_its_root_is_declared(
    arm: RobotFiles, tmp_path: Path
) -> None:
    copied = copy_into_twin(arm, tmp_path / "ws")
    assert copied.model == arm.model
    assert copied.roots == {"arm": arm.root}
    plain = RobotFiles(arm.model, [arm.model], arm.model.parent)
    assert copy_into_twin(plain, tmp_path / "ws").roots == {}


def test_special_characters_in_the_name_of_a_root_are_replaced(tmp_path: Path) -> None:
    root = tmp_path / "my arm (v2)"
    model = file(root / "arm.urdf")
    assert list(copy_into_twin(RobotFiles(model, [model], root), tmp_path / "t").roots) == [
        "my_arm__v2_"
    ]


def test_an_existing_asset_is_not_overwritten(arm: RobotFiles, tmp_path: Path) -> None:
    copy_into_twin(arm, tmp_path / "twin")
    with pytest.raises(SpecError, match="the folder for the asset exists"):
        copy_into_twin(arm, tmp_path / "twin")
