"""Links are followed into the same store and where the user allows it, and nowhere else."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pytest_twin.errors import PathError, PointerError
from pytest_twin.formats.declared_inputs import DeclaredInputs, declaring
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.paths import Roots, open_regular, read_bytes

CONTENT = b"content"
DIGEST = "9a0364b9e99bb480dd25e1f0284c8555"


def put(path: Path, content: bytes = CONTENT) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def linked(link: Path, target: Path) -> Path:
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(os.path.relpath(target, link.parent))
    return link


def hugging_face(folder: Path) -> Path:
    blob = put(folder / "datasets--me--arm/blobs/0a1b")
    return linked(folder / "datasets--me--arm/snapshots/1234/meta/info.json", blob)


def annex(folder: Path) -> Path:
    key = "SHA256E-s7--0a1b.mcap"
    content = put(folder / f"data/.git/annex/objects/Xx/9k/{key}/{key}")
    return linked(folder / "data/session/a.mcap", content)


def dvc(folder: Path) -> Path:
    put(folder / "data/.dvc/config", b"[core]\n    remote = lab\n")
    content = put(folder / f"data/.dvc/cache/files/md5/{DIGEST[:2]}/{DIGEST[2:]}")
    return linked(folder / "data/a.mcap", content)


def shared_dvc(folder: Path) -> Path:
    content = put(folder / f"shared/{DIGEST[:2]}/{DIGEST[2:]}")
    put(folder / "data/.dvc/config", f"[cache]\n    dir = {folder}/shared\n".encode())
    return linked(folder / "data/a.mcap", content)


def workspace(folder: Path) -> Path:
    mesh = put(folder / "ws/src/arm/meshes/a.stl")
    return linked(folder / "ws/install/arm/share/arm/meshes/a.stl", mesh)


def beside(folder: Path) -> Path:
    return linked(folder / "data/latest.mcap", put(folder / "data/2026/a.mcap"))


STORES = [hugging_face, annex, dvc, shared_dvc, workspace, beside]


@pytest.mark.parametrize("store", STORES)
def test_a_link_that_ends_in_its_own_store_is_followed(store, tmp_path: Path) -> None:
    link = store(tmp_path)
    assert read_bytes(link, 100) == CONTENT
    assert file_sha256(link) == file_sha256(put(tmp_path / "same"))
    at = link.parent / "robot.urdf"
    assert Roots(link.parent).resolve(link.name, at=at) == link.resolve()


@pytest.mark.parametrize("store", STORES)
def test_a_release_follows_no_link(store, tmp_path: Path) -> None:
    with pytest.raises(PathError, match="is a symbolic link"):
        open_regular(store(tmp_path), links=False)


def secret(folder: Path) -> Path:
    return put(folder / "secret/key")


def out_of_snapshots(folder: Path) -> Path:
    hugging_face(folder)
    return linked(folder / "datasets--me--arm/snapshots/1234/out", secret(folder))


def out_of_annex(folder: Path) -> Path:
    annex(folder)
    return linked(folder / "data/out", put(folder / "data2/.git/annex/objects/a"))


def any_folder_as_cache(folder: Path) -> Path:
    put(folder / "data/.dvc/config", f"[cache]\n    dir = {secret(folder).parent}\n".encode())
    return linked(folder / "data/out", folder / "secret/key")


def up_from_cache(folder: Path) -> Path:
    dvc(folder)
    return linked(folder / "data/out", secret(folder))


def out_of_workspace(folder: Path) -> Path:
    workspace(folder)
    return linked(folder / "ws/install/out", secret(folder))


def by_way_of_a_store(folder: Path) -> Path:
    """A link into the store, where another link leads out of it."""
    link = hugging_face(folder)
    link.resolve().unlink()
    linked(folder / "datasets--me--arm/blobs/0a1b", secret(folder))
    return link


def broken_configuration(folder: Path) -> Path:
    put(folder / "data/.dvc/config", b"\xff[cache\ndir = /")
    return linked(folder / "data/out", secret(folder))


ESCAPES = [
    out_of_snapshots, out_of_annex, any_folder_as_cache, up_from_cache, out_of_workspace,
    by_way_of_a_store, broken_configuration,
]  # fmt: skip


@pytest.mark.parametrize("escape", ESCAPES)
def test_a_link_that_ends_elsewhere_is_refused_with_the_option(escape, tmp_path: Path) -> None:
    link = escape(tmp_path)
    option = f"--root {link.resolve().parent}"
    with pytest.raises(PathError, match="is a link to another folder") as caught:
        read_bytes(link, 100)
    assert option in str(caught.value)
    with pytest.raises(PathError, match="leaves the declared roots") as caught:
        Roots(link.parent).resolve(link.name, at=link.parent / "robot.urdf")
    assert option in str(caught.value)
    with declaring(DeclaredInputs((link.resolve().parent,))):
        assert read_bytes(link, 100) == CONTENT
    with pytest.raises(PathError):
        read_bytes(link, 100)


@pytest.fixture
def pointer(tmp_path: Path) -> Path:
    text = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 12345\n"
    return put(tmp_path / "arm.stl", text.encode())


def test_a_git_lfs_pointer_is_called_that(pointer: Path) -> None:
    with pytest.raises(PointerError, match=r"arm\.stl: is a Git LFS pointer.*run git lfs pull"):
        read_bytes(pointer, 1000)
    assert file_sha256(pointer)


@pytest.mark.parametrize("target", ["../blobs/0a1b", "./gone.stl", "beside.stl"])
def test_a_link_that_git_wrote_as_text_is_called_that(target: str, tmp_path: Path) -> None:
    """With core.symlinks off, as on Windows, git writes the target without a line feed."""
    put(tmp_path / "beside.stl", CONTENT)
    link = put(tmp_path / "arm.stl", target.encode())
    with pytest.raises(PointerError, match=r"arm\.stl: is a link that was checked out") as caught:
        read_bytes(link, 1000)
    assert caught.value.value == target
    assert file_sha256(link)


@pytest.mark.parametrize("text", ["arm.stl", "1.0", "time", "../arm.stl\n", "a/b", ".", ""])
def test_another_short_file_is_no_link(text: str, tmp_path: Path) -> None:
    assert read_bytes(put(tmp_path / "arm.stl", text.encode()), 1000) == text.encode()
