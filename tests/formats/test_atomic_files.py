"""Files and folders are written atomically."""

from __future__ import annotations

import json
import math
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from pytest_twin.errors import FormatError, PathError
from pytest_twin.formats import atomic


def test_writing_a_file_leaves_no_temporary_files(tmp_path: Path) -> None:
    atomic.write_text(tmp_path / "a", "é\r\n")
    assert (tmp_path / "a").read_bytes() == "é\r\n".encode()
    atomic.write_bytes(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["a"]  # noqa: PTH208


def test_an_unknown_number_is_null_because_other_readers_refuse_nan(tmp_path: Path) -> None:
    document = {"ci95": [math.nan, -math.inf], "value": 1.5, "deep": [({"limit": math.inf},)]}
    atomic.write_json(tmp_path / "a.json", document)

    def refuse(name: str) -> None:
        raise AssertionError(name)

    read = json.loads((tmp_path / "a.json").read_text(), parse_constant=refuse)
    assert read == {"ci95": [None, None], "value": 1.5, "deep": [[{"limit": None}]]}


def test_a_replaced_file_keeps_its_mode_and_a_new_file_follows_the_umask(tmp_path: Path) -> None:
    old = tmp_path / "old"
    old.write_text("x")
    old.chmod(0o640)
    mask = os.umask(0o027)
    try:
        atomic.write_text(old, "y")
        atomic.write_text(tmp_path / "new", "y")
    finally:
        os.umask(mask)
    assert stat.S_IMODE(old.stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o640


def test_an_interrupted_write_keeps_the_old_content(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("old")

    def write_interrupted() -> None:
        with atomic.open_replacement(path) as stream:
            stream.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_interrupted()
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a"]


def test_a_killed_writer_keeps_the_old_content(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("old")
    code = (
        "import os, sys, pathlib\n"
        "from pytest_twin.formats import atomic\n"
        "with atomic.open_replacement(pathlib.Path(sys.argv[1])) as stream:\n"
        "    stream.write(b'half'); stream.flush(); os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert done.returncode == -9
    assert path.read_text() == "old"


def test_symbolic_links_and_folders_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "folder").mkdir()
    for name in ("link", "folder"):
        with pytest.raises(PathError, match="is not a regular file"):
            atomic.write_text(tmp_path / name, "new")
    assert (tmp_path / "real").read_text() == "old"


def test_an_impossible_write_is_reported(tmp_path: Path) -> None:
    with pytest.raises(PathError, match="cannot be written: No such file"):
        atomic.write_text(tmp_path / "none" / "a", "x")
    with pytest.raises(FormatError, match="text that cannot be encoded in UTF-8"):
        atomic.write_text(tmp_path / "a", "\ud800")
    assert list(tmp_path.iterdir()) == []


def _folder(path: Path, content: str) -> Path:
    path.mkdir()
    (path / "a").write_text(content)
    return path


def test_creating_a_folder_never_replaces_an_existing_one(tmp_path: Path) -> None:
    final = tmp_path / "final"
    assert atomic.create_directory(_folder(tmp_path / "one", "1"), final)
    assert not atomic.create_directory(_folder(tmp_path / "two", "2"), final)
    assert (final / "a").read_text() == "1"
