"""Restore the files of a release in the twin's folder, as one change.

A killed rollback either changed nothing, or left the folder ``.twin/rollback`` with all new files.
Then every command refuses to load the twin, and the next rollback completes it.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pytest_twin.errors import PathError, ReleaseError, TwinError, cannot_write
from pytest_twin.formats import atomic, file_set, temporary
from pytest_twin.formats.file_set import ChangeSet, FileChange
from pytest_twin.formats.paths import open_regular
from pytest_twin.release import folder as folders
from pytest_twin.release.restore import copy_files, place_of, read_authentic
from pytest_twin.release.statement import Release
from pytest_twin.twin import FILE_NAME, PENDING_ROLLBACK

REPLACED = ".twin/before-rollback"
"""Folder for copies of replaced files, in one folder for each rollback."""
_COPIES = "copies"
"""Folder of these copies in a staging or pending folder."""


@dataclass(frozen=True, slots=True)
class Rollback:
    """A rollback that is planned or done.

    Attributes:
        number: number of the restored release.
        changes: files that differ from the release.
        copies: folder with the replaced files; None if no file was replaced.
        notes: newer releases that cannot be restored, and why.
    """

    twin: str
    number: int
    changes: tuple[FileChange, ...]
    copies: Path | None = None
    notes: tuple[str, ...] = ()


def plan(root: Path, folder: Path | None = None, *, now: datetime | None = None) -> Rollback:
    """Compare a release with the twin's files; changes nothing.

    Args:
        root: the twin's folder.
        folder: folder of the release; the newest one that is signed and undamaged if None.
        now: time for the verification; the present time if None.

    Raises:
        ReleaseError: the release is unsigned, damaged, or by a key that is not trusted.
        PathError: a file or a folder of the twin is a link, or cannot be read.
    """
    release, _, notes = _release(root, folder, now or datetime.now(UTC))
    return Rollback(release.twin, release.number, changed_files(root, release), notes=notes)


def restore(root: Path, folder: Path | None = None, *, now: datetime | None = None) -> Rollback:
    """Restore the files of a release in a twin.

    All files are copied and checked before the first is replaced, ``twin.yaml`` last. The replaced
    files are copied to a folder of their own.

    Args:
        root, folder, now: as for :func:`plan`.

    Raises:
        ReleaseError: as :func:`plan`; or files could not be replaced, and the rollback is pending.
        PathError: as :func:`plan`, or the disk cannot be written; then no file was changed.
    """
    now = now or datetime.now(UTC)
    release, folder, notes = _release(root, folder, now)
    changes = changed_files(root, release)
    if not changes:
        return Rollback(release.twin, release.number, (), notes=notes)
    pending = root / PENDING_ROLLBACK
    file_set.check_folders(root, f"{REPLACED}/copy")
    facts = {
        "twin": release.twin,
        "release": release.number,
        "copies": now.strftime("%Y%m%dT%H%M%SZ"),
    }
    with (
        atomic.folder_in_use(pending.parent),
        temporary.temporary_folder(pending.parent) as staging,
    ):
        _stage(root, staging, changes, release, folder)
        file_set.begin(staging, pending, ChangeSet(changes, FILE_NAME, False, facts))
        done = _complete(root, pending)
    return Rollback(done.twin, done.number, done.changes, done.copies, notes)


def resume(root: Path) -> Rollback | None:
    """Complete a rollback that was interrupted; None if there is none.

    Raises:
        ReleaseError: another process is doing it, or files cannot be replaced.
    """
    pending = root / PENDING_ROLLBACK
    file_set.check_folders(root, f"{PENDING_ROLLBACK}/journal")
    temporary.sweep(pending.parent)
    if not pending.is_dir():
        return None
    with temporary.locked(pending) as is_free:
        if not is_free:
            raise ReleaseError(
                "another rollback is running", path=pending, expected="one at a time"
            )
        return _complete(root, pending)


def _stage(
    root: Path, staging: Path, changes: Iterable[FileChange], release: Release, folder: Path
) -> None:
    """Copy the new files, and the files that they will replace, into a staging folder."""
    new = staging / file_set.NEW
    copy_files(release, folder, new)
    try:
        for change in changes:
            (new / change.path).chmod(atomic.mode_for(root / change.path))
            if change.before is not None:
                _copy(root / change.path, staging / _COPIES / change.path)
    except OSError as error:
        raise cannot_write(error, staging) from None


def _complete(root: Path, pending: Path) -> Rollback:
    try:
        change_set = file_set.apply(root, pending)
        copies = _put_copies(root, pending, change_set.facts)
        file_set.discard(pending)
    except TwinError as error:
        raise ReleaseError(
            f"a rollback is unfinished: {error}",
            path=root,
            expected="pytest-twin rollback once that is mended, which completes it; to leave the "
            f"files as they are, delete {pending}",
        ) from None
    facts = change_set.facts
    return Rollback(str(facts["twin"]), int(facts["release"]), change_set.changes, copies)


def _put_copies(root: Path, pending: Path, facts: Mapping[str, Any]) -> Path | None:
    """Move the copies of replaced files to their folder, which no other rollback has."""
    copies, folder = pending / _COPIES, root / REPLACED
    if not copies.is_dir():
        return None
    atomic.make_folder(folder)
    for number in itertools.count(1):
        name = str(facts["copies"]) + (f"-{number}" if number > 1 else "")
        if atomic.create_directory(copies, folder / name):
            break
    return folder / name


def _release(
    root: Path, folder: Path | None, now: datetime
) -> tuple[Release, Path, tuple[str, ...]]:
    """A release, its folder, and notes on newer ones that cannot be restored."""
    if folder is not None:
        return read_authentic(folder, now), folder, ()
    notes: list[str] = []
    for number, candidate in folders.numbered_releases(root / folders.RELEASES):
        try:
            return read_authentic(candidate, now), candidate, tuple(notes)
        except TwinError as error:
            notes.append(f"release {number} is passed over: {error}")
    raise ReleaseError(
        "no release to restore",
        path=root / folders.RELEASES,
        value="; ".join(notes) or None,
        expected="a signed and undamaged release",
    )


def changed_files(root: Path, release: Release) -> tuple[FileChange, ...]:
    """Files of a release that the twin lacks or has with other content.

    Raises:
        PathError: a file or one of its folders is a link, or cannot be read.
    """
    changes = []
    for entry in release.files:
        path_in_twin = place_of(entry)
        if path_in_twin is None:
            continue
        if not file_set.is_plain(path_in_twin):
            raise PathError(
                "a file outside the twin",
                path=root,
                value=path_in_twin,
                expected="files inside the twin",
            )
        file_set.check_folders(root, path_in_twin)
        digest = file_set.digest_of(root / path_in_twin)
        if digest != entry.sha256:
            changes.append(FileChange(path_in_twin, digest, entry.sha256))
    return tuple(sorted(changes, key=lambda change: change.path))


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with open_regular(source, links=False) as stream, target.open("wb") as sink:
        shutil.copyfileobj(stream, sink)
