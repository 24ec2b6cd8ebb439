"""A twin as a release holds it, laid out so that it loads."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pytest_twin.errors import ReleaseError
from pytest_twin.formats import atomic, yaml
from pytest_twin.release.folder import RELEASES
from pytest_twin.release.restore import authentic, copy_files
from pytest_twin.release.statement import Release
from pytest_twin.twin import FILE_NAME

_OF_RECORDINGS = ("budget", "ranges")
"""Sections of ``twin.yaml`` that no comparison of two twins needs."""


def release_folder(root: Path, number: int) -> Path:
    """The folder of a twin's release.

    Raises:
        ReleaseError: it is not there.
    """
    folder = root / RELEASES / f"{number:04d}"
    if not folder.is_dir():
        raise ReleaseError(
            f"release {number} is not in this twin",
            path=root / RELEASES,
            expected=f"the folder {folder.name} that the data set was stamped with",
        )
    return folder


def authentic_now(folder: Path) -> Release:
    """A release that is signed by a trusted key and undamaged, of whatever age.

    Raises:
        ReleaseError: it is not.
    """
    return authentic(folder, datetime.now(UTC))


def lay_out(release: Release, folder: Path, root: Path, into: Path) -> Path:
    """Copy the files of a release to where its ``twin.yaml`` expects them.

    Sections that name recordings are left out: a release holds no recordings. Every copy is
    compared with the signed digest. Folders under ``roots:`` that lie outside the twin are those of
    today.

    Args:
        release: authenticated.
        folder: of the release.
        root: the twin's folder today.
        into: an empty folder.

    Returns:
        The ``twin.yaml``.

    Raises:
        ReleaseError: a file is not what was signed, or there is no ``twin.yaml``.
        PathError: a file is missing, or cannot be copied.
    """
    copy_files(release, folder, into)
    file = into / FILE_NAME
    data = yaml.load(file).data
    if not isinstance(data, dict):
        return file
    kept = {key: value for key, value in data.items() if key not in _OF_RECORDINGS}
    if data.get("roots"):
        kept["roots"] = _absolute(data["roots"], root)
    if kept != data:
        atomic.write_text(file, json.dumps(kept))
    return file


def _absolute(roots: Any, root: Path) -> Any:
    """Roots for the laid out copy: absolute, but for those inside the twin's folder."""

    def placed(reference: str) -> str:
        folder = (root / reference).resolve()
        return reference if folder.is_relative_to(root.resolve()) else str(folder)

    if isinstance(roots, dict):
        return {name: placed(folder) for name, folder in roots.items()}
    return [placed(folder) for folder in roots]
