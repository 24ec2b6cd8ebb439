"""``pytest-twin rollback`` restores the last signed release and nothing unsigned."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path

import jsonschema
import pytest
from killed import Killed, at_every_operation, killed_after
from release_twins import MakeRelease

from pytest_twin import cli
from pytest_twin.errors import SpecError
from pytest_twin.formats import temporary
from pytest_twin.formats.schema import load_schema
from pytest_twin.release.rollback import restore
from pytest_twin.twin import load_twin

OLD = "<mujoco><worldbody/></mujoco>\n"


@pytest.fixture
def twin_with_two_releases(root: Path, make: MakeRelease) -> Path:
    """A twin with two releases of different models and a third, unreleased model."""
    make(datetime.now(UTC))
    (root / "arm.xml").write_text("<mujoco model='b'><worldbody/></mujoco>\n")
    make(datetime.now(UTC))
    (root / "arm.xml").write_text("today")
    (root / "meshes" / "link.stl").unlink()
    return root


def test_rollback_restores_the_newest_release_and_keeps_a_copy_of_replaced_files(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "done.json"
    assert cli.main(["rollback", "--twin", str(twin_with_two_releases), "--json", str(out)]) == 0
    done = json.loads(out.read_text())
    jsonschema.validate(done, load_schema("results/rollback.schema.json"))
    assert done["release"] == 2
    assert done["replaced"] == ["arm.xml", "meshes/link.stl"]
    assert "model='b'" in (twin_with_two_releases / "arm.xml").read_text()
    assert (twin_with_two_releases / "meshes" / "link.stl").read_bytes() == bytes(range(97))
    assert (Path(done["kept"]) / "arm.xml").read_text() == "today"
    # The files are those of the last release now, which only --release leaves.
    capsys.readouterr()
    assert cli.main(["rollback", "--twin", str(twin_with_two_releases)]) == 0
    assert "nothing to restore: the files are those of release 2" in capsys.readouterr().out
    assert "model='b'" in (twin_with_two_releases / "arm.xml").read_text()


def test_rollback_restores_a_given_release(twin_with_two_releases: Path) -> None:
    older = str(twin_with_two_releases / "releases" / "0001")
    twin = str(twin_with_two_releases / "twin.yaml")
    assert cli.main(["rollback", "--twin", twin, "--release", older]) == 0
    assert (twin_with_two_releases / "arm.xml").read_text() == OLD


@pytest.mark.parametrize("harm", ["unsigned", "signature", "file", "key"])
def test_rollback_refuses_a_release_that_is_not_validly_signed(
    harm: str, twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = twin_with_two_releases / "releases" / "0002"
    envelope = folder / "release.dsse.json"
    if harm == "unsigned":
        envelope.unlink()
    elif harm == "signature":
        other = json.loads(
            (twin_with_two_releases / "releases" / "0001" / "release.dsse.json").read_text()
        )
        mixed = json.loads(envelope.read_text()) | {"signatures": other["signatures"]}
        envelope.write_text(json.dumps(mixed, sort_keys=True, separators=(",", ":")))
    elif harm == "file":
        (folder / "files" / "arm.xml").write_text("<mujoco/>")
    else:
        for key in (twin_with_two_releases / "keys").iterdir():
            key.unlink()
    before = (twin_with_two_releases / "arm.xml").read_text()
    assert (
        cli.main(["rollback", "--twin", str(twin_with_two_releases), "--release", str(folder)]) == 2
    )
    assert "does not hold" in capsys.readouterr().err
    assert (twin_with_two_releases / "arm.xml").read_text() == before
    if harm == "key":
        return
    # Without a given release, the newest valid one is restored, and the others are named.
    assert cli.main(["rollback", "--twin", str(twin_with_two_releases)]) == 0
    assert "release 2 is passed over: " in capsys.readouterr().out
    assert (twin_with_two_releases / "arm.xml").read_text() == OLD


def content(root: Path) -> dict[str, bytes]:
    """Files of a twin other than releases and outputs."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in root.rglob("*")
        if path.is_file() and path.relative_to(root).parts[0] not in (".twin", "releases")
    }


def test_a_dry_run_lists_the_files_and_changes_none(
    twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = content(twin_with_two_releases)
    assert cli.main(["rollback", "--dry-run", "--twin", str(twin_with_two_releases)]) == 0
    shown = capsys.readouterr().out
    assert "would restore: release 2 of 'arm' (2 files replaced)" in shown
    assert "  arm.xml\n  meshes/link.stl (new)\n" in shown
    assert content(twin_with_two_releases) == before
    assert not (twin_with_two_releases / ".twin").exists()


@pytest.mark.parametrize("linked", ["meshes", "arm.xml", ".twin"])
def test_links_in_the_twin_are_neither_followed_nor_written_through(
    linked: str, twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = twin_with_two_releases
    elsewhere = tmp_path / "elsewhere"
    if linked == "arm.xml":
        (root / "arm.xml").rename(elsewhere)
    else:
        elsewhere.mkdir()
        shutil.rmtree(root / linked, ignore_errors=True)
    (root / linked).symlink_to(elsewhere)
    before = content(root)
    assert cli.main(["rollback", "--twin", str(root)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{root / linked}: is a" in line
    assert "link" in line
    assert content(root) == before
    assert elsewhere.is_file() or list(elsewhere.iterdir()) == []


def test_two_rollbacks_within_a_second_keep_their_copies_apart(
    twin_with_two_releases: Path,
) -> None:
    now = datetime.now(UTC)
    first = restore(twin_with_two_releases, now=now)
    (twin_with_two_releases / "arm.xml").write_text("tomorrow")
    second = restore(twin_with_two_releases, now=now)
    assert first.copies is not None
    assert second.copies is not None
    assert (first.copies / "arm.xml").read_text() == "today"
    assert (second.copies / "arm.xml").read_text() == "tomorrow"


def test_a_rollback_killed_at_any_file_operation_changes_nothing_or_is_completed(
    twin_with_two_releases: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    release = twin_with_two_releases / "releases" / "0002"
    (twin_with_two_releases / "twin.yaml").write_text("name: arm\nmodel: other.xml\n")
    today = content(twin_with_two_releases)
    now = datetime.now(UTC)
    completed = 0

    def prepare() -> None:
        nonlocal root
        temporary._swept.clear()
        root = tmp_path / "copies" / str(len(list((tmp_path / "copies").glob("*"))))
        shutil.copytree(twin_with_two_releases, root)

    def check(operations: int) -> None:
        nonlocal completed
        temporary._swept.clear()
        copies = root / ".twin" / "before-rollback"
        if (root / ".twin" / "rollback").is_dir():
            completed += 1
            with pytest.raises(SpecError, match="a rollback was interrupted"):
                load_twin(root / "twin.yaml")
            # A file that somebody edits meanwhile is not overwritten.
            (root / "golden" / "fk" / "home.yaml").write_text("kind: fk  # mine\n")
            assert cli.main(["rollback", "--twin", str(root / "meshes")]) == 0
            assert "completed the interrupted rollback to release 2" in capsys.readouterr().out
            (root / "golden" / "fk" / "home.yaml").write_text("kind: fk\n")
        else:
            assert content(root) in (today, restored)
            assert cli.main(["rollback", "--twin", str(root)]) == 0
        assert content(root) == restored
        assert [path.read_text() for path in copies.rglob("arm.xml")] == ["today"]
        assert [p.name for p in (root / ".twin").iterdir()] == ["before-rollback"]
        prepare()

    (tmp_path / "copies").mkdir()
    root = tmp_path
    prepare()
    restore(root, root / "releases" / "0002", now=now)
    restored = content(root)
    assert restored != today
    prepare()
    kills = at_every_operation(
        lambda: restore(root, root / "releases" / release.name, now=now), check
    )
    assert kills > 30
    assert completed > 5


def test_an_edited_file_stops_the_completion_of_a_rollback(
    twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = twin_with_two_releases
    for operations in range(100):
        with contextlib.suppress(Killed), killed_after(operations):
            restore(root)
        if (root / ".twin" / "rollback").is_dir():
            break
    (root / "arm.xml").write_text("mine")
    assert cli.main(["rollback", "--twin", str(root)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "a rollback is unfinished: " in line
    assert f"{root / 'arm.xml'}: was written or changed by somebody else" in line
    assert (root / "arm.xml").read_text() == "mine"


def test_rollback_without_a_signed_release_is_refused(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["rollback", "--twin", str(root)]) == 2
    assert "no release to restore" in capsys.readouterr().err
