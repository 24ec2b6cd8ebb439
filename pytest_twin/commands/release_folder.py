"""Resolve TWIN and RELEASE on a command line."""

from __future__ import annotations

from pathlib import Path

from pytest_twin import release
from pytest_twin.errors import PathError, ReleaseError
from pytest_twin.twin import FILE_NAME

TWIN_HELP = "twin.yaml or its folder"
RELEASE_HELP = "folder of a release, or of a twin for its newest release"


def twin_file(given: Path) -> Path:
    """Return the ``twin.yaml`` in a folder, or the given file.

    Raises:
        PathError: no such file.
    """
    file = given / FILE_NAME if given.is_dir() else given
    if not file.is_file():
        raise PathError("no such file", path=file, expected=f"a {FILE_NAME}, or its folder")
    return file


def twin_folder(given: Path) -> Path:
    """Return the folder of a twin from its ``twin.yaml`` or its folder.

    Raises:
        ReleaseError: there is no twin.
    """
    folder = given.parent if given.name == FILE_NAME else given
    if not (folder / FILE_NAME).is_file():
        raise ReleaseError("no twin", path=given, expected=TWIN_HELP)
    return folder.absolute()


def release_folder(given: Path) -> Path:
    """Return the folder of a release: the given one, or the newest of a twin.

    Raises:
        ReleaseError: not a folder, or a twin without a release.
    """
    if not given.is_dir():
        raise ReleaseError("no such release", path=given, expected="the folder of a release")
    if (given / FILE_NAME).exists() or (given / "releases").is_dir():
        found = release.newest(given)
        if found is None:
            raise ReleaseError(
                "this twin has no release yet",
                path=given,
                expected="a signed release; pytest --twin-release writes one",
            )
        return found
    return given
