"""Create and check the folder that a command writes to."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.errors import PathError, TwinError


def make(folder: Path) -> Path:
    """Create ``folder`` if it is missing, and return it.

    Raises:
        PathError: a file has that name, or the parent cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PathError(
            f"not a folder that can be written: {error.strerror}", path=folder, where="--out"
        ) from None
    return folder


def check_replaceable(folder: Path, file_name: str, what: str) -> None:
    """Check that a folder may be replaced: it is new, empty, or an earlier result.

    Args:
        folder: absolute path.
        file_name: file that identifies an earlier result.
        what: noun for the result, such as ``diagnosis``.

    Raises:
        TwinError: the parent folder does not exist.
        PathError: a file or a folder with other content has that name.
    """
    if not folder.parent.is_dir():
        raise TwinError("no such folder", path=folder.parent, expected="a folder that exists")
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise PathError("is not a folder", path=folder, expected="a folder or nothing")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / file_name).is_file():
        raise PathError(
            "a folder with other files is not replaced",
            path=folder,
            expected=f"a new folder, or that of an earlier {what}",
        )
