"""Record of the releases that this user has accepted, to detect a rollback to an older one.

Each series of releases has one small file in the user's state folder. It is neither secret nor
signed: it protects against an old release from outside, not against the user of the machine.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import platformdirs

from pytest_twin.errors import PathError, ReleaseError, TwinError
from pytest_twin.formats import atomic
from pytest_twin.formats.paths import read_bytes

_MAX_BYTES = 4096
"""Largest size of a record."""


def highest(series: str) -> int | None:
    """Highest accepted release number of a series (32 hex digits), or None.

    Raises:
        ReleaseError: the record cannot be read.
    """
    path = _path(series)
    if not path.exists():
        return None
    try:
        number = json.loads(read_bytes(path, _MAX_BYTES, links=False))["number"]
    except (ValueError, KeyError, TypeError):
        number = None
    if type(number) is not int:
        raise ReleaseError(
            "the record of accepted releases cannot be read",
            path=path,
            expected='{"number": N}; delete the file to accept any release again',
        )
    return number


def remember(series: str, number: int) -> str | None:
    """Record an accepted release; a note if that is not possible, else None."""
    path = _path(series)
    known = highest(series)
    if known is not None and known >= number:
        return None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic.write_text(path, json.dumps({"number": number}) + "\n")
    except (OSError, PathError):
        return (
            f"cannot remember this release in {path.parent}: an older release will not be noticed"
        )
    return None


def remember_twin(series: str, root: Path) -> None:
    """Record the folder of a twin by its series, so that its stamped data can be checked."""
    path = _twin_path(series)
    with contextlib.suppress(OSError, PathError):
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic.write_text(path, json.dumps({"root": str(root)}) + "\n")


def twin_of(series: str) -> Path | None:
    """Recorded folder of the twin of a series; None without a record or if it does not exist."""
    path = _twin_path(series)
    try:
        root = Path(json.loads(read_bytes(path, _MAX_BYTES, links=False))["root"])
    except (TwinError, ValueError, KeyError, TypeError):
        return None
    return root if root.is_dir() else None


def _twin_path(series: str) -> Path:
    return platformdirs.user_state_path("pytest-twin") / "twins" / f"{series}.json"


def _path(series: str) -> Path:
    return platformdirs.user_state_path("pytest-twin") / "releases" / f"{series}.json"
