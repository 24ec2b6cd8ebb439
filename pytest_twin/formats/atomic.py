"""Atomic writes of files and folders: readers see the old content or the new, never a part."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from pytest_twin.errors import FormatError, PathError, cannot_write
from pytest_twin.formats.temporary import temporary_file


@contextlib.contextmanager
def open_replacement(path: Path) -> Iterator[BinaryIO]:
    """Open a binary stream whose content replaces ``path`` when the block ends without an error.

    The stream is a temporary file in the same folder. It is synced to the disk and renamed to
    ``path``, and keeps the mode of the replaced file. An error or a crash leaves the old content.

    Raises:
        PathError: ``path`` is a link, a folder or a device, or its folder cannot be written.
    """
    mode = mode_for(path)
    try:
        with temporary_file(path.parent) as (temporary, descriptor):
            with os.fdopen(os.dup(descriptor), "w+b") as stream:
                yield stream
                stream.flush()
                os.fchmod(stream.fileno(), mode)
                os.fsync(stream.fileno())
            temporary.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise cannot_write(error, path) from error


def make_folder(path: Path) -> None:
    """Create a folder and its missing parents.

    Raises:
        PathError: a file has that name, or the operating system refuses.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise PathError(
            "is not a folder, or inside a file", path=path, expected="a folder or nothing"
        ) from None
    except OSError as error:
        raise cannot_write(error, path) from None


@contextlib.contextmanager
def folder_in_use(path: Path) -> Iterator[None]:
    """Context with a folder; it and its parents, as far as created here, go if they stay empty.

    Raises:
        PathError: as :func:`make_folder`.
    """
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    make_folder(path)
    try:
        yield
    finally:
        for folder in missing:
            with contextlib.suppress(OSError):
                folder.rmdir()


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` atomically.

    Raises:
        PathError: as :func:`open_replacement`.
    """
    with open_replacement(path) as stream:
        stream.write(data)


def write_json(path: Path, document: object) -> None:
    """Write a document as indented JSON.

    Raises:
        PathError: as :func:`open_replacement`.
    """
    write_text(path, json_text(document))


def json_text(document: object) -> str:
    """A document as indented JSON, in which a number that is not known or not finite is null.

    JSON has no such numbers, and other readers refuse a file with NaN.
    """
    return json.dumps(without_non_finite(document), indent=2, allow_nan=False) + "\n"


def without_non_finite(value: object) -> Any:
    """The value with null in place of each number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: without_non_finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [without_non_finite(inner) for inner in value]
    return value


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` as UTF-8, atomically and with unchanged line ends.

    Raises:
        PathError: as :func:`open_replacement`.
        FormatError: the text contains half of a surrogate pair.
    """
    try:
        data = text.encode("utf-8")
    except UnicodeEncodeError:
        raise FormatError(
            "text that cannot be encoded in UTF-8",
            path=path,
            expected="text without lone surrogates",
        ) from None
    write_bytes(path, data)


def create_directory(staging: Path, final: Path) -> bool:
    """Rename the finished folder ``staging`` to ``final`` unless ``final`` exists.

    Everything in ``staging`` is synced first. If several processes try, exactly one succeeds.

    Returns:
        True if the folder was renamed; False if ``final`` existed, and ``staging`` is unchanged.

    Raises:
        PathError: ``staging`` is not a folder, or the operating system refuses.
    """
    if staging.is_symlink() or not staging.is_dir():
        raise PathError("not a folder", path=staging, expected="the folder to move into place")
    if final.is_symlink() or final.exists():
        return False
    try:
        sync_tree(staging)
        staging.rename(final)
        sync_folder(final.parent)
    except OSError as error:
        # A rename never replaces a folder that is not empty.
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            return False
        raise PathError(f"cannot be made: {error.strerror or error}", path=final) from error
    return True


def mode_for(path: Path) -> int:
    """Mode of a new file that replaces ``path``: that of the present file, else by the umask.

    Raises:
        PathError: ``path`` is a link, a folder or a device, or cannot be reached.
    """
    try:
        found = path.lstat()
    except FileNotFoundError:
        # The process's umask can only be read by setting it.
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask
    except OSError as error:
        raise cannot_write(error, path) from error
    if not stat.S_ISREG(found.st_mode):
        raise PathError(
            "is not a regular file and is not overwritten",
            path=path,
            expected="a path to a regular file, or to nothing yet",
        )
    return stat.S_IMODE(found.st_mode)


def sync_folder(folder: Path) -> None:
    """Write the entries of a folder from memory to the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Write all files and folders below ``folder`` from memory to the disk."""
    for parent, _, files in os.walk(folder):
        for name in files:
            path = Path(parent) / name
            if path.is_symlink() or not path.is_file():
                continue
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        sync_folder(Path(parent))
