"""The root folder of a model: the nearest suitable folder with all files that it references."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import pytest

from pytest_twin.realization.files.root import Folder, Mark, choose, inside
from pytest_twin.realization.files.surroundings import folders_above

HOME = Path("/home/ann")


def above(model: str, marks: dict[str, Mark] | None = None) -> list[Folder]:
    shared = {Path("/"), Path("/home"), HOME, HOME / "Downloads"}
    known = {Path(path): mark for path, mark in (marks or {}).items()}
    return [Folder(path, known.get(path), path in shared) for path in Path(model).parents]


def root(model: str, *named: str, marks: dict[str, Mark] | None = None) -> str:
    return str(choose(above(model, marks), [Path(model).parent / name for name in named]).folder)


def test_the_root_of_a_model_with_files_beside_it_is_its_own_folder() -> None:
    assert root("/home/ann/arm/arm.urdf", "a.stl", "meshes/b.stl") == "/home/ann/arm"
    assert root("/home/ann/arm/arm.urdf") == "/home/ann/arm"


def test_meshes_in_a_sibling_folder_make_the_common_parent_the_root() -> None:
    assert root("/home/ann/arm/urdf/arm.urdf", "../meshes/a.stl") == "/home/ann/arm"
    named = ("../../stls/a.stl", "b.stl")
    assert root("/home/ann/hand/xml/left/hand.xml", *named) == "/home/ann/hand"


def test_the_root_of_a_model_in_a_package_is_the_package() -> None:
    marks: dict[str, Mark] = {"/home/ann/ws/arm": "package", "/home/ann/ws": "checkout"}
    assert root("/home/ann/ws/arm/urdf/arm.urdf", "a.stl", marks=marks) == "/home/ann/ws/arm"


def test_a_package_recognized_by_its_folder_name_is_the_root() -> None:
    model = "/home/ann/ws/arm/urdf/arm.urdf"
    named = [Path("/home/ann/ws/arm/urdf/a.stl")]
    found = choose(above(model), named, [Path("/home/ann/ws/arm")])
    assert str(found.folder) == "/home/ann/ws/arm"
    assert found.why == "its package, by the folder's name 'arm'"


def test_a_package_may_reference_files_only_within_its_checkout() -> None:
    marks: dict[str, Mark] = {"/home/ann/ws/repo/arm": "package", "/home/ann/ws/repo": "checkout"}
    model = "/home/ann/ws/repo/arm/urdf/arm.urdf"
    assert root(model, "../../meshes/a.stl", marks=marks) == "/home/ann/ws/repo"
    assert root(model, "../../../other/a.stl", marks=marks) == "/home/ann/ws/repo/arm"


def test_a_package_without_checkout_may_not_reference_files_outside_it() -> None:
    marks: dict[str, Mark] = {"/home/ann/ws/arm": "package"}
    model = "/home/ann/ws/arm/urdf/arm.urdf"
    assert root(model, "../../secret.stl", marks=marks) == "/home/ann/ws/arm"


@pytest.mark.parametrize(
    ("model", "named"),
    [
        ("/home/ann/arm/arm.urdf", "../.ssh/id.stl"),
        ("/home/ann/Downloads/arm.urdf", "../.ssh/id.stl"),
        ("/home/ann/Downloads/arm/arm.urdf", "../taxes.stl"),
        ("/home/ann/arm/arm.urdf", "../../bob/a.stl"),
        ("/home/ann/arm/arm.urdf", "/etc/passwd"),
        ("/home/ann/arm/arm.urdf", "../../../../../../etc/passwd"),
    ],
)
def test_shared_folders_such_as_home_or_system_folders_are_never_the_root(
    model: str, named: str
) -> None:
    assert root(model, named) == str(PurePosixPath(model).parent)


def test_a_reference_outside_does_not_affect_the_root_of_the_others() -> None:
    model = "/home/ann/arm/urdf/arm.urdf"
    assert root(model, "../meshes/a.stl", "/opt/b.stl") == "/home/ann/arm"


def test_folders_with_a_common_name_prefix_are_distinguished() -> None:
    assert root("/home/ann/x/arm/a.urdf", "../arm2/m.stl") == "/home/ann/x"


def test_home_system_and_temporary_folders_count_as_shared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home/ann"
    (home / "Downloads/arm").mkdir(parents=True)
    monkeypatch.setenv("HOME", str(home))
    found = folders_above(home / "Downloads/arm/arm.urdf")
    shared = {folder.path for folder in found if folder.is_shared}
    assert {home, home / "Downloads", tmp_path / "home", Path("/")} <= shared
    assert [folder.path for folder in inside(found)] == [home / "Downloads/arm"]
    assert all(folder.is_shared for folder in folders_above(Path("/tmp/arm.urdf")))


def test_packages_and_checkouts_are_recognized_by_their_files(tmp_path: Path) -> None:
    (tmp_path / "repo/.git").mkdir(parents=True)
    (tmp_path / "repo/arm/urdf").mkdir(parents=True)
    (tmp_path / "repo/arm/package.xml").write_text("<package/>")
    marks = [f.mark for f in folders_above(tmp_path / "repo/arm/urdf/a.urdf")[:3]]
    assert marks == [None, "package", "checkout"]
