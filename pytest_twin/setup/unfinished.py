"""Mark a twin that is being set up: no command takes one for whole whose init was killed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from pytest_twin.errors import SpecError, cannot_write
from pytest_twin.formats import atomic, temporary
from pytest_twin.formats.paths import read_bytes
from pytest_twin.twin import UNFINISHED_INIT

_SET_ASIDE = ".twin/unfinished"
"""Folder for the files of an init that was killed, in one folder for each."""
_MOST_BYTES = 64 * 2**20


@contextmanager
def marked(folder: Path, before: Iterable[Path]) -> Iterator[None]:
    """Context in which the twin in ``folder`` is marked as unfinished.

    The mark is a list of files in a folder that this process locks. Loading a twin is refused if
    its mark has no owner.

    Args:
        folder: the twin's folder.
        before: files and folders in it that are not of the new twin.
    """
    mark = folder / UNFINISHED_INIT
    names = sorted(path.relative_to(folder).as_posix() for path in before)
    atomic.make_folder(mark.parent)
    with temporary.locked(mark.parent):
        atomic.write_text(mark, json.dumps(names))
        yield
        mark.unlink()
        mark.parent.rmdir()


def set_aside(folder: Path, written: Iterable[Path]) -> Path | None:
    """Move the files of an init that was killed out of the way; None if there was none.

    Args:
        folder: the twin's folder.
        written: files and folders at the places to which an init writes, contents first.

    Returns:
        Folder with the moved files.

    Raises:
        SpecError: an init is running in this folder.
        PathError: a file cannot be moved.
    """
    mark = folder / UNFINISHED_INIT
    if not mark.is_file():
        return None
    aside = folder / _SET_ASIDE / datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    try:
        with temporary.locked(mark.parent) as is_free:
            if not is_free:
                raise SpecError(
                    "another init is setting up a twin here", path=folder, expected="one at a time"
                )
            before = json.loads(read_bytes(mark, _MOST_BYTES))
            for path in list(written):
                name = path.relative_to(folder).as_posix()
                if name not in before and mark.parent not in (path, path.parent):
                    _move(path, aside / name)
            mark.unlink()
            mark.parent.rmdir()
    except OSError as error:
        raise cannot_write(error, folder) from None
    return aside


def _move(path: Path, to: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        with suppress(OSError):  # A folder with files that were there before.
            path.rmdir()
        return
    atomic.make_folder(to.parent)
    path.replace(to)
