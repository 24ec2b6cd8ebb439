"""Resolve RELEASE on a command line: a release's folder, or a twin's."""

from __future__ import annotations

from pathlib import Path

from pytest_twin import release
from pytest_twin.errors import ReleaseError


def release_folder(given: Path) -> Path:
    """Return the folder of a release: the given one, or the newest of a twin.

    Raises:
        ReleaseError: not a folder, or a twin without a release.
    """
    if not given.is_dir():
        raise ReleaseError("no such release", path=given, expected="the folder of a release")
    if (given / "twin.yaml").exists() or (given / "releases").is_dir():
        found = release.newest(given)
        if found is None:
            raise ReleaseError(
                "this twin has no release yet",
                path=given,
                expected="a signed release; pytest --twin-release writes one",
            )
        return found
    return given
