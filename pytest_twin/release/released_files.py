"""Copy the files of a release into a folder in which its twin can be loaded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pytest_twin.errors import ReleaseError
from pytest_twin.formats import atomic, yaml
from pytest_twin.release.folder import RELEASES
from pytest_twin.release.restore import copy_files
from pytest_twin.release.statement import Release
from pytest_twin.twin import FILE_NAME

_RECORDING_SECTIONS = ("budget", "ranges")
"""Sections of ``twin.yaml`` that the comparison of two twins does not need."""


def release_folder(root: Path, number: int) -> Path:
    """Folder of a release of a twin.

    Raises:
        ReleaseError: it does not exist.
    """
    folder = root / RELEASES / f"{number:04d}"
    if not folder.is_dir():
        raise ReleaseError(
            f"release {number} is not in this twin",
            path=root / RELEASES,
            expected=f"the folder {folder.name} that the data set was stamped with",
        )
    return folder


def copy_release(release: Release, folder: Path, root: Path, into: Path) -> Path:
    """Copy the files of a release to the places that its ``twin.yaml`` refers to.

    Sections that name recordings are removed, because a release contains no recordings. The digest
    of each copy is compared with the signed one. Folders under ``roots:`` outside the twin are the
    present ones.

    Args:
        release: a verified release.
        root: present folder of the twin.
        into: an empty folder.

    Returns:
        Path of the copied ``twin.yaml``.

    Raises:
        ReleaseError: a file differs from the signed one, or there is no ``twin.yaml``.
        PathError: a file does not exist, or cannot be copied.
    """
    copy_files(release, folder, into)
    file = into / FILE_NAME
    data = yaml.load(file).data
    if not isinstance(data, dict):
        return file
    kept = {key: value for key, value in data.items() if key not in _RECORDING_SECTIONS}
    if data.get("roots"):
        kept["roots"] = _absolute(data["roots"], root)
    if kept != data:
        atomic.write_text(file, json.dumps(kept))
    return file


def _absolute(roots: Any, root: Path) -> Any:
    """Roots for the copied twin: absolute paths, except for folders inside the twin."""

    def placed(reference: str) -> str:
        folder = (root / reference).resolve()
        return reference if folder.is_relative_to(root.resolve()) else str(folder)

    if isinstance(roots, dict):
        return {name: placed(folder) for name, folder in roots.items()}
    return [placed(folder) for folder in roots]
