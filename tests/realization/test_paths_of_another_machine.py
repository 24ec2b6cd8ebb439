"""Mesh paths that another machine wrote: found in the package of that name, or refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_located_files import loaded, stl, urdf

from pytest_twin.asset.realize import realize
from pytest_twin.errors import PathError
from pytest_twin.realization import load


@pytest.fixture(autouse=True)
def _no_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH"):
        monkeypatch.delenv(name, raising=False)


PREFIX = "/home/ana/ws/install/arm_description/share/arm_description"


@pytest.mark.parametrize(
    ("mesh", "note"),
    [
        (f"{PREFIX}/meshes/a.stl", f"{PREFIX} is taken for package 'arm_description'"),
        (f"file://{PREFIX}/meshes/a.stl", f"{PREFIX} is taken for package 'arm_description'"),
        (
            "file:///opt/ros/humble/share/arm_description/meshes/a.stl",
            "/opt/ros/humble/share/arm_description is taken for package 'arm_description'",
        ),
        (
            "$(find arm_description)/meshes/a.stl",
            "$(find arm_description) is taken for package 'arm_description'",
        ),
        (
            "file://$(find arm_description)/meshes/a.stl",
            "$(find arm_description) is taken for package 'arm_description'",
        ),
        (
            "package://Arm_Description/meshes/a.stl",
            "package://Arm_Description is taken for package 'arm_description'",
        ),
        (
            "package://arm_description/arm_description/meshes/a.stl",
            "package://arm_description/arm_description is taken for package 'arm_description'",
        ),
        (
            "/c/ROS/share/ARM_DESCRIPTION/meshes/a.stl",
            "/c/ROS/share/ARM_DESCRIPTION is taken for package 'arm_description'",
        ),
    ],
)
@pytest.mark.parametrize("where", ["above", "beside", "declared"])
def test_the_mesh_is_found_in_the_package_of_that_name_with_a_note(
    tmp_path: Path, mesh: str, note: str, where: str
) -> None:
    package = tmp_path / "ws" / "arm_description"
    stl(package / "meshes/a.stl")
    folders = {
        "above": package / "urdf",
        "beside": tmp_path / "ws" / "bringup",
        "declared": tmp_path / "elsewhere",
    }
    path = urdf(folders[where], mesh)
    options = {"packages": {"arm_description": package}} if where == "declared" else {}

    located = loaded(path, **options)

    assert note in located.words()
    assert located.packages.found["arm_description"].folder == package


def test_realize_says_which_package_took_the_place(tmp_path: Path) -> None:
    stl(tmp_path / "arm_description/meshes/a.stl")
    path = urdf(tmp_path / "arm_description/urdf", f"{PREFIX}/meshes/a.stl")
    out = tmp_path / "out"
    out.mkdir()

    made = realize(str(path), str(out))

    assert f"{PREFIX} is taken for package 'arm_description'" in made["located"]["words"]


def test_a_file_that_exists_as_written_is_never_replaced(tmp_path: Path) -> None:
    here = tmp_path / "ws"
    written = stl(here / "share/arm_description/meshes/a.stl")
    stl(here / "arm_description/meshes/a.stl").write_bytes(b"another mesh")
    path = urdf(here / "urdf", str(written))

    located = loaded(path)

    assert not located.packages.found
    assert load(path).source.files == (written, path)


@pytest.mark.parametrize(
    "mesh",
    [
        f"{PREFIX}/meshes/a.stl",
        "$(find arm_description)/meshes/a.stl",
        "package://arm_description/meshes/a.stl",
    ],
)
def test_a_package_that_is_not_here_is_refused_with_its_option(tmp_path: Path, mesh: str) -> None:
    path = urdf(tmp_path / "robot", mesh)

    with pytest.raises(PathError, match="package 'arm_description' is not found") as caught:
        load(path)

    assert "--package arm_description=FOLDER" in str(caught.value)
    assert caught.value.line == 4


def test_two_packages_whose_names_differ_in_case_are_not_guessed_between(tmp_path: Path) -> None:
    for name in ("arm_description", "ARM_description"):
        stl(tmp_path / name / "meshes/a.stl")
    path = urdf(tmp_path / "robot", "package://Arm_Description/meshes/a.stl")

    with pytest.raises(PathError, match="package 'Arm_Description' is not found"):
        load(path)


def test_a_path_of_another_machine_opens_no_file_outside_the_package(tmp_path: Path) -> None:
    stl(tmp_path / "secret.stl")
    (tmp_path / "ws/arm_description/meshes").mkdir(parents=True)
    (tmp_path / "ws/arm_description/package.xml").write_text("<package/>")
    path = urdf(tmp_path / "ws/arm_description/urdf", "/opt/share/arm_description/../../secret.stl")

    with pytest.raises(PathError):
        load(path)
