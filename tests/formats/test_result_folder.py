"""Results of several files appear together; files of users are never replaced or removed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from killed import at_every_operation, full_after

from pytest_twin.errors import PathError
from pytest_twin.formats import results, temporary
from pytest_twin.formats.results import MANIFEST, result_folder

OLD = {"main.json": "old", "page.html": "old", "model/only-old.xml": "old", "model/arm.xml": "old"}
NEW = {"main.json": "new", "page.html": "new", "model/arm.xml": "new", "only-new.csv": "new"}


@pytest.fixture
def without_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disks need milliseconds for each synchronization."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def write(folder: Path, files: Mapping[str, str], **options: object) -> None:
    with result_folder(folder, "main.json", **options) as staging:  # type: ignore[arg-type]
        for name, text in files.items():
            (staging / name).parent.mkdir(exist_ok=True)
            (staging / name).write_text(text)


def content(folder: Path) -> dict[str, str]:
    """Visible files; what begins with a dot is bookkeeping."""
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in folder.rglob("*")
        if path.is_file() and not path.relative_to(folder).as_posix().startswith(".")
    }


def test_a_result_replaces_the_earlier_one_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "made" / "out"
    write(out, OLD)
    (out / "model" / "notes.txt").write_text("mine")
    write(out, NEW)
    assert content(out) == {**NEW, "model/notes.txt": "mine"}
    assert sorted(path.name for path in out.iterdir() if path.name.startswith(".")) == [MANIFEST]
    # Empty folders of the earlier result go too.
    (out / "model" / "notes.txt").unlink()
    write(out, {"main.json": "third"})
    assert not (out / "model").exists()


def test_an_edited_or_foreign_file_is_refused_in_one_line_and_stays(tmp_path: Path) -> None:
    write(tmp_path, OLD)
    for edited in ("main.json", "model/only-old.xml"):
        before = (tmp_path / edited).read_text()
        (tmp_path / edited).write_text("mine")
        with pytest.raises(PathError, match="changed by somebody else, and is not replaced"):
            write(tmp_path, NEW)
        assert (tmp_path / edited).read_text() == "mine"
        (tmp_path / edited).write_text(before)
    (tmp_path / "only-new.csv").write_text("mine")
    with pytest.raises(PathError, match=r"only-new.csv: was written or changed by somebody else"):
        write(tmp_path, NEW)
    assert content(tmp_path) == {**OLD, "only-new.csv": "mine"}
    # A file that the user named on the command line is replaced.
    write(tmp_path, NEW, replaceable=["only-new.csv"])
    assert content(tmp_path) == NEW


def test_two_results_share_a_folder(tmp_path: Path) -> None:
    write(tmp_path, OLD)
    with result_folder(tmp_path, "other.json") as staging:
        (staging / "other.json").write_text("other")
    write(tmp_path, NEW)
    assert content(tmp_path) == {**NEW, "other.json": "other"}


def test_a_project_folder_is_refused_where_a_result_needs_its_own_folder(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text("mine")
    (tmp_path / "main.json").write_text("mine")
    with pytest.raises(PathError, match="is not replaced"):
        write(tmp_path, NEW, alone=True)
    assert content(tmp_path) == {"robot.urdf": "mine", "main.json": "mine"}


def test_links_in_the_folder_are_not_written_through(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "model").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(PathError, match="is a link where a folder is expected"):
        write(tmp_path / "out", NEW)
    assert list((tmp_path / "elsewhere").iterdir()) == []
    # The user may name the folder itself by a link.
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    write(tmp_path / "link", NEW)
    assert content(tmp_path / "elsewhere") == NEW


def test_a_failed_command_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    write(tmp_path, OLD)
    for folder in (tmp_path, tmp_path / "a" / "b"):
        with pytest.raises(KeyboardInterrupt), result_folder(folder, "main.json"):
            raise KeyboardInterrupt
    assert content(tmp_path) == OLD
    assert not (tmp_path / "a").exists()


@pytest.mark.usefixtures("without_sync")
@pytest.mark.parametrize("next_process", [False, True])
def test_a_kill_at_any_file_operation_never_leaves_old_files_beside_new_ones(
    tmp_path: Path, next_process: bool
) -> None:
    folders = iter(range(1000))
    out = tmp_path

    def run() -> None:
        write(out, NEW)

    def prepare() -> None:
        nonlocal out
        out = tmp_path / str(next(folders))
        write(out, OLD)

    def check(operations: int) -> None:
        # The next command is another process, which has swept nothing yet.
        temporary._swept.clear()
        files = content(out)
        assert len(set(files.values())) <= 1, operations
        if "main.json" in files:
            assert files in (OLD, NEW), operations
        if next_process:
            results.finish(out)
            assert content(out) in (OLD, NEW)
        write(out, NEW)
        assert content(out) == NEW
        assert [path.name for path in out.iterdir() if path.name.startswith(".")] == [MANIFEST]
        prepare()

    prepare()
    assert at_every_operation(run, check) > 20


@pytest.mark.usefixtures("without_sync")
def test_a_disk_that_becomes_full_leaves_one_result_whole(tmp_path: Path) -> None:
    for operations in range(100):
        out = tmp_path / str(operations)
        write(out, OLD)
        temporary._swept.clear()
        problem = None
        try:
            with full_after(operations):
                write(out, NEW)
        except (PathError, OSError) as error:
            problem = str(error)
        if problem is None:
            break
        assert "No space left on device" in problem
        assert len(set(content(out).values())) <= 1
        results.finish(out)
        assert content(out) in (OLD, NEW)
    assert operations > 5
    assert content(out) == NEW


@pytest.mark.usefixtures("without_sync")
def test_a_killed_first_result_shows_its_main_file_last(tmp_path: Path) -> None:
    out = tmp_path / "0"

    def check(operations: int) -> None:
        nonlocal out
        files = content(out) if out.exists() else {}
        assert "main.json" not in files or files == NEW
        out = tmp_path / str(operations + 1)

    assert at_every_operation(lambda: write(out, NEW), check) > 10


def test_temporary_folders_of_ended_processes_are_swept(tmp_path: Path) -> None:
    code = (
        "import os, sys, pathlib\n"
        "from pytest_twin.formats import atomic, temporary\n"
        "folder = pathlib.Path(sys.argv[1])\n"
        "with temporary.temporary_folder(folder), temporary.temporary_file(folder):\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert done.returncode == -9
    assert len(list(tmp_path.iterdir())) == 2
    (tmp_path / ".twin-else").mkdir()
    with temporary.temporary_folder(tmp_path) as folder:
        # A folder whose process runs stays, as do those of other programs.
        temporary._swept.clear()
        temporary.sweep(tmp_path)
        assert {path.name for path in tmp_path.iterdir()} == {folder.name, ".twin-else"}
    assert [path.name for path in tmp_path.iterdir()] == [".twin-else"]
