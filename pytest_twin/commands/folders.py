"""The folder that a command writes to."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.errors import PathError, TwinError


def make(folder: Path) -> Path:
    """``folder``, made where it is not there.

    Raises:
        PathError: a file is in the way, or the place cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PathError(
            f"no folder to write to: {error.strerror}", path=folder, where="--out"
        ) from None
    return folder


def check_replaceable(folder: Path, file_name: str, what: str) -> None:
    """Check that a folder may be replaced whole: it is new, empty, or holds an earlier result.

    Args:
        folder: absolute.
        file_name: file by which an earlier result is known.
        what: the result, in words, such as ``diagnosis``.

    Raises:
        TwinError: no folder to put it in.
        PathError: something else is there.
    """
    if not folder.parent.is_dir():
        raise TwinError("no such folder", path=folder.parent, expected="a folder that exists")
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise PathError("is in the way of a folder", path=folder, expected="a folder or nothing")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / file_name).is_file():
        raise PathError(
            "a folder with other things in it is not replaced",
            path=folder,
            expected=f"a new folder, or that of an earlier {what}",
        )
