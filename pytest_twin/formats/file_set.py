"""Replace several files as one change that a killed process leaves undone or to be completed.

The new files are staged in a folder. Its rename to a fixed name, the pending folder, is the point
from which the change counts. Then the files are moved to their places. While the pending folder
exists, the change is incomplete; :func:`apply` completes it, in the same process or in a later one.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from pytest_twin.errors import FormatError, PathError, cannot_write
from pytest_twin.formats import atomic, temporary
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.paths import decode_text, read_bytes

NEW = "new"
"""Folder of the new files in a staging or pending folder."""
_JOURNAL = "journal.json"
_MAX_BYTES = 16 * 2**20
"""Largest size of a journal."""


@dataclass(frozen=True, slots=True)
class FileChange:
    """Change of one file.

    Attributes:
        path: relative to the changed folder, with ``/``.
        before: SHA-256 of the present file; None if there is none.
        after: SHA-256 of the new file; None if the file is removed.
    """

    path: str
    before: str | None
    after: str | None


@dataclass(frozen=True, slots=True)
class ChangeSet:
    """Changes that belong together.

    Attributes:
        changes: one for each file.
        last: path of the file whose presence tells readers that the others are complete.
        withdraw: whether all old files are removed before the first new one appears, ``last``
            first. Otherwise each new file replaces the old one in one step.
        facts: further JSON fields for the process that completes the change.
    """

    changes: tuple[FileChange, ...]
    last: str
    withdraw: bool
    facts: Mapping[str, Any]


def begin(staging: Path, pending: Path, change_set: ChangeSet) -> None:
    """Make a staged change count; :func:`apply` then moves the files.

    Args:
        staging: folder on the file system of the files; its subfolder ``new`` has the new files.
        pending: path of the pending folder, which must not exist.

    Raises:
        PathError: the disk cannot be written, or another change is pending.
    """
    document = {
        "schema": 1,
        "changes": [[c.path, c.before, c.after] for c in change_set.changes],
        "last": change_set.last,
        "withdraw": change_set.withdraw,
        "facts": dict(change_set.facts),
    }
    try:
        atomic.write_text(staging / _JOURNAL, json.dumps(document))
        if not atomic.create_directory(staging, pending):
            raise PathError(
                "another process is writing here", path=pending, expected="one command at a time"
            )
    except OSError as error:
        raise cannot_write(error, pending) from None


def apply(root: Path, pending: Path) -> ChangeSet:
    """Move the files of a pending change to their places; completes an interrupted call.

    Raises:
        PathError: a file was changed since the change began, a folder is a link, or the disk
            cannot be written.
        FormatError: the pending folder has no valid journal.
    """
    change_set = _read(pending / _JOURNAL)
    changes = sorted(change_set.changes, key=lambda change: change.path != change_set.last)
    to_do = []
    for change in changes:
        check_folders(root, change.path)
        staged = pending / NEW / change.path
        if change.after is not None and not staged.exists():
            continue  # An earlier call has moved it.
        if digest_of(root / change.path) not in (None, change.before):
            raise edited(root / change.path)
        to_do.append(change)
    try:
        for change in to_do:
            if change_set.withdraw or change.after is None:
                (root / change.path).unlink(missing_ok=True)
        for change in reversed(to_do):
            if change.after is not None:
                _move(pending / NEW / change.path, root / change.path)
        _remove_empty_folders(root, [c.path for c in changes if c.after is None])
        for folder in {(root / change.path).parent for change in to_do}:
            if folder.is_dir():
                atomic.sync_folder(folder)
    except OSError as error:
        raise cannot_write(error, root) from None
    return change_set


def discard(pending: Path) -> None:
    """Delete the pending folder of an applied change; a killed deletion is swept later."""
    with temporary.temporary_folder(pending.parent) as folder:
        try:
            pending.rename(folder / "applied")
            atomic.sync_folder(pending.parent)
        except OSError as error:
            raise cannot_write(error, pending) from None


def digest_of(path: Path) -> str | None:
    """SHA-256 of a regular file; None if there is nothing.

    Raises:
        PathError: a link, a folder or a device.
    """
    return file_sha256(path) if path.is_symlink() or path.exists() else None


def check_folders(root: Path, path: str) -> None:
    """Check that no folder between ``root`` and a file is a link, which a write would follow.

    Raises:
        PathError: one is.
    """
    folder = root
    for part in PurePosixPath(path).parts[:-1]:
        folder = folder / part
        if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
            raise PathError(
                "is a link where a folder is expected, and is not followed"
                if folder.is_symlink()
                else "is not a folder",
                path=folder,
                expected=f"a folder for {path}: move it, or replace the link by its folder",
            )


def edited(path: Path) -> PathError:
    """Error for a file that somebody else wrote or changed."""
    return PathError(
        "was written or changed by somebody else, and is not replaced",
        path=path,
        expected="the file as pytest-twin wrote it, or none: move it, or give another folder",
    )


def is_plain(path: object) -> bool:
    """Whether a value from a file is a relative path that stays in its folder."""
    if not isinstance(path, str) or not path or "\0" in path:
        return False
    pure = PurePosixPath(path)
    return not pure.is_absolute() and ".." not in pure.parts and str(pure) == path


def _move(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        source.replace(target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        # A folder of a twin may be on another file system.
        with source.open("rb") as stream, atomic.open_replacement(target) as sink:
            shutil.copyfileobj(stream, sink)
        source.unlink()


def _remove_empty_folders(root: Path, paths: Iterable[str]) -> None:
    parents = {parent for path in paths for parent in PurePosixPath(path).parents}
    for parent in sorted(parents - {PurePosixPath()}, key=lambda p: -len(p.parts)):
        folder = root / parent
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _read(path: Path) -> ChangeSet:
    try:
        data = json.loads(decode_text(read_bytes(path, _MAX_BYTES), path))
        changes = tuple(FileChange(*item) for item in data["changes"])
        change_set = ChangeSet(changes, data["last"], bool(data["withdraw"]), dict(data["facts"]))
    except (ValueError, KeyError, TypeError, RecursionError):
        change_set = None
    if change_set is None or not all(is_plain(change.path) for change in change_set.changes):
        raise FormatError("not a journal of changed files", path=path, expected="an intact file")
    return change_set
