"""The folder that a command writes to."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.errors import PathError


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
