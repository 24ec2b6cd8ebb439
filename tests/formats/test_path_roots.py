"""References to files must stay inside the declared root folders."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from pytest_twin.errors import FormatError, LimitError, PathError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.paths import Roots, decode_text, open_regular, read_bytes


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    root = tmp_path / "twin"
    (root / "meshes" / "deep").mkdir(parents=True)
    (root / "meshes" / "a.stl").write_text("a")
    (root / "twin.yaml").write_text("model: x\n")
    (tmp_path / "shared" / "in").mkdir(parents=True)
    (tmp_path / "shared" / "b.stl").write_text("b")
    (tmp_path / "secret").write_text("s")
    return root


def resolve(root: Path, reference: str, *extra: Path, folder: bool = False) -> Path:
    roots = Roots(root, extra)
    at = root / "twin.yaml"
    return roots.resolve(reference, at=at, line=7, where="model", folder=folder)


@pytest.mark.parametrize(
    "reference",
    ["meshes/a.stl", "./meshes//a.stl", "meshes/deep/../a.stl", "../twin/meshes/a.stl"],
)
def test_files_inside_the_root_are_found(twin: Path, reference: str) -> None:
    assert resolve(twin, reference) == twin / "meshes" / "a.stl"
    assert resolve(twin, str(twin / reference)) == twin / "meshes" / "a.stl"


def test_declared_inputs_outside_the_twin_are_roots_too(twin: Path) -> None:
    shared = twin.parent / "shared"
    assert resolve(twin, "../shared/b.stl", shared) == shared / "b.stl"
    assert resolve(twin, str(shared / "b.stl"), shared) == shared / "b.stl"
    with pytest.raises(PathError, match="leaves the declared roots"):
        resolve(twin, "../secret", shared)


def test_a_root_behind_a_symbolic_link_is_the_same_root(twin: Path) -> None:
    alias = twin.parent / "alias"
    alias.symlink_to(twin)
    assert resolve(alias, "meshes/a.stl") == twin / "meshes" / "a.stl"
    assert resolve(alias, str(alias / "meshes/a.stl")) == twin / "meshes" / "a.stl"


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        ("", "empty path"),
        ("  ", "empty path"),
        ("a\0b", "a control character"),
        ("a\nb", "a control character"),
        ("x/" * 3000, "path is too long"),
        ("x" * 256, "a name in the path is too long"),
        ("\ud800", "a character that no file name can have"),
        ("package://robot/a.stl", "a URL, not a path"),
        ("../secret", "leaves the declared roots"),
        ("..", "leaves the declared roots"),
        ("../../../../../../../../etc/passwd", "leaves the declared roots"),
        ("/etc/passwd", "leaves the declared roots"),
        ("/", "leaves the declared roots"),
        ("/no/such/thing", "leaves the declared roots"),
        ("meshes/none.stl", "no such file"),
        ("meshes/a.stl/b", "cannot be reached"),
        ("meshes", "not a regular file but a folder"),
    ],
)
def test_an_invalid_reference_is_refused_with_file_and_line(
    twin: Path, reference: str, words: str
) -> None:
    with pytest.raises(PathError) as caught:
        resolve(twin, reference)
    assert words in str(caught.value)
    assert (caught.value.path, caught.value.line) == (twin / "twin.yaml", 7)
    assert caught.value.where == "model"


def test_a_folder_with_the_root_name_as_prefix_is_outside(twin: Path) -> None:
    (twin.parent / "twin-evil").mkdir()
    (twin.parent / "twin-evil" / "x").write_text("x")
    with pytest.raises(PathError, match="leaves the declared roots"):
        resolve(twin, "../twin-evil/x")


@pytest.mark.parametrize("target", ["../../secret", "../../../..", "/etc/passwd"])
def test_symbolic_links_out_of_the_root_are_refused(twin: Path, target: str) -> None:
    (twin / "meshes" / "link").symlink_to(target)
    with pytest.raises(PathError):
        resolve(twin, "meshes/link")


def test_a_path_that_leaves_the_root_and_returns_is_refused(twin: Path) -> None:
    outside = twin.parent / "outside"
    outside.mkdir()
    (outside / "back").symlink_to(twin)
    (twin / "out").symlink_to(outside)
    (twin / "up").symlink_to("..")
    for reference in ("out/back/meshes/a.stl", "up/twin/meshes/a.stl"):
        with pytest.raises(PathError, match="leaves the declared roots"):
            resolve(twin, reference)


def test_a_symbolic_link_inside_the_root_resolves_to_its_target(twin: Path) -> None:
    (twin / "alias.stl").symlink_to("meshes/a.stl")
    assert resolve(twin, "alias.stl") == twin / "meshes" / "a.stl"


def test_a_cyclic_symbolic_link_is_refused(twin: Path) -> None:
    (twin / "loop").symlink_to("loop")
    with pytest.raises(PathError, match="cannot be reached"):
        resolve(twin, "loop")


def test_pipes_sockets_and_devices_are_refused(twin: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(twin / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        # A socket address may have at most about 100 bytes.
        monkeypatch.chdir(twin)
        server.bind("sock")
    for name, kind in (("pipe", "a pipe"), ("sock", "a socket")):
        with pytest.raises(PathError, match=f"not a regular file but {kind}"):
            resolve(twin, name)
        with pytest.raises(PathError):
            open_regular(twin / name)
    with pytest.raises(PathError, match="a device"):
        open_regular(Path("/dev/null"))


def test_a_reference_to_a_folder_is_resolved_on_request(twin: Path) -> None:
    assert resolve(twin, "meshes", folder=True) == twin / "meshes"
    with pytest.raises(PathError, match="not a folder"):
        resolve(twin, "twin.yaml", folder=True)
    with pytest.raises(PathError, match="no such folder"):
        resolve(twin, "none", folder=True)


def test_read_bytes_refuses_files_above_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_bytes(path, 5) == b"12345"
    with pytest.raises(LimitError, match=r"got 5 bytes; expected at most 4 bytes"):
        read_bytes(path, 4)
    with pytest.raises(PathError, match="no such file"):
        read_bytes(tmp_path / "b", 4)
    with pytest.raises(PathError):
        read_bytes(tmp_path, 4)
    with pytest.raises(PathError, match="null"):
        read_bytes(Path("a\0b"), 4)


def test_read_bytes_limits_files_that_report_size_zero() -> None:
    # Files in /proc report size 0 but have content.
    with pytest.raises(LimitError):
        read_bytes(Path("/proc/self/status"), 10)


def test_file_sha256_equals_the_published_test_vector(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert file_sha256(tmp_path / "a") == expected


def test_invalid_utf8_is_reported_with_line_and_column() -> None:
    with pytest.raises(FormatError) as caught:
        decode_text(b"ab\nc\xc3\xa9\x80", Path("x"))
    assert (caught.value.line, caught.value.column) == (2, 3)


def test_a_folder_that_is_declared_twice_is_named_once(tmp_path):
    at = tmp_path / "twin.yaml"
    with pytest.raises(PathError) as caught:
        Roots(tmp_path, (tmp_path, tmp_path / ".")).resolve("../other.xml", at=at)
    assert caught.value.expected.startswith(f"a path inside {tmp_path}; to allow")


def test_the_option_that_is_proposed_names_the_package(twin: Path) -> None:
    """One mesh is rarely the last: the package has its textures and the other meshes."""
    meshes = twin.parent / "arm_description" / "meshes" / "visual"
    meshes.mkdir(parents=True)
    (meshes / "a.stl").write_text("a")
    (meshes.parents[1] / "package.xml").write_text("<package/>")
    with pytest.raises(PathError) as caught:
        resolve(twin, "../arm_description/meshes/visual/a.stl")
    assert f"--root {meshes.parents[1]} on the command line" in str(caught.value)
