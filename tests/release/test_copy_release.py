"""Restoring the files of a released twin into a folder."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from release_twins import MakeRelease

from pytest_twin.errors import ReleaseError
from pytest_twin.release.released_files import copy_release, release_folder
from pytest_twin.twin import load_twin


def test_released_files_are_restored_and_roots_outside_the_twin_point_to_the_current_ones(
    root: Path, make: MakeRelease, tmp_path: Path
) -> None:
    (root / "twin.yaml").write_text(
        "name: arm\nmodel: arm.xml\nroots: {shared: ../shared, meshes: meshes}\n"
    )
    (tmp_path / "shared").mkdir()
    released = make()
    (root / "arm.xml").write_text("today")
    into = tmp_path / "past"
    into.mkdir()
    file = copy_release(released, release_folder(root, 1), root, into)
    roots = yaml.safe_load(file.read_text())["roots"]
    assert roots == {"shared": str(tmp_path / "shared"), "meshes": "meshes"}
    assert (into / "arm.xml").read_text() == "<mujoco><worldbody/></mujoco>\n"
    assert (into / "meshes" / "link.stl").read_bytes() == bytes(range(97))


def test_a_changed_or_missing_release_is_not_laid_out(
    root: Path, make: MakeRelease, tmp_path: Path
) -> None:
    released = make()
    folder = release_folder(root, 1)
    (folder / "files" / "arm.xml").write_text("<mujoco/>")
    with pytest.raises(ReleaseError, match="not the file that was signed"):
        copy_release(released, folder, root, tmp_path)
    with pytest.raises(ReleaseError, match="release 2 is not in this twin"):
        release_folder(root, 2)


def test_a_twin_is_laid_out_without_its_recordings(
    root: Path, make: MakeRelease, tmp_path: Path
) -> None:
    (root / "twin.yaml").write_text(
        "name: arm\nmodel: arm.xml\nbudget: {recordings: [moves.mcap]}\n"
        "ranges: {final: [final.mcap]}\n"
    )
    (root / "moves.mcap").write_bytes(b"")
    (root / "final.mcap").write_bytes(b"")
    released = make()
    into = tmp_path / "past"
    into.mkdir()
    file = copy_release(released, release_folder(root, 1), root, into)
    assert load_twin(file).budget.recordings == ()
