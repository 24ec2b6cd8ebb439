"""A twin as a release holds it, laid out so that it loads."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from pytest_twin.errors import PathError, ReleaseError
from pytest_twin.formats import atomic, yaml
from pytest_twin.formats.digest import file_sha256
from pytest_twin.release.folder import RELEASES
from pytest_twin.release.statement import Release
from pytest_twin.release.verify import FILES
from pytest_twin.twin import FILE_NAME


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


def lay_out(release: Release, folder: Path, root: Path, into: Path) -> Path:
    """Copy the files of a release to where its ``twin.yaml`` expects them.

    Every copy is held against the signed digest. Folders under ``roots:`` that lie outside the
    twin are those of today.

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
    for entry in release.files:
        if not entry.name.startswith(f"{FILES}/"):
            continue
        source = folder / entry.name
        target = into / (entry.original or entry.name.removeprefix(f"{FILES}/"))
        if not target.resolve().is_relative_to(into.resolve()):
            raise ReleaseError("a file that leaves its folder", path=folder, value=entry.original)
        if file_sha256(source) != entry.sha256:
            raise ReleaseError(
                "not the file that was signed",
                path=source,
                expected="the release as it was written; pytest-twin verify says more",
            )
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
        except OSError as error:
            raise PathError(f"cannot be copied: {error.strerror}", path=source) from None
    file = into / FILE_NAME
    if not file.is_file():
        raise ReleaseError(f"a release without {FILE_NAME}", path=folder)
    data = yaml.load(file).data
    if isinstance(data, dict) and data.get("roots"):
        atomic.write_text(file, json.dumps({**data, "roots": _absolute(data["roots"], root)}))
    return file


def _absolute(roots: Any, root: Path) -> Any:
    """Roots as they are told from the laid out copy: those inside the twin stay relative."""

    def told(reference: str) -> str:
        folder = (root / reference).resolve()
        return reference if folder.is_relative_to(root.resolve()) else str(folder)

    if isinstance(roots, dict):
        return {name: told(folder) for name, folder in roots.items()}
    return [told(folder) for folder in roots]
