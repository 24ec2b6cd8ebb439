"""Read a release that is signed and undamaged, and copy its files."""

from __future__ import annotations

import shutil
from datetime import datetime
from pathlib import Path

from pytest_twin.errors import PathError, ReleaseError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.paths import open_regular
from pytest_twin.release.check import AGE_CODES, check
from pytest_twin.release.statement import FileEntry, Release
from pytest_twin.release.verify import FILES
from pytest_twin.twin import FILE_NAME


def place_of(entry: FileEntry) -> str | None:
    """Path of a released file in the twin's folder; None for results and report."""
    if not entry.name.startswith(f"{FILES}/"):
        return None
    return entry.original or entry.name.removeprefix(f"{FILES}/")


def copy_files(release: Release, folder: Path, into: Path) -> None:
    """Copy the files of a release below ``into``, to the paths that its ``twin.yaml`` refers to.

    The digest of each copy is compared with the signed one.

    Raises:
        ReleaseError: a file differs from the signed one, or there is no ``twin.yaml``.
        PathError: a file does not exist, or cannot be copied.
    """
    for entry in release.files:
        place = place_of(entry)
        if place is None:
            continue
        target = into / place
        if not target.resolve().is_relative_to(into.resolve()):
            raise ReleaseError(
                "a file outside the folder", path=folder, value=place,
                expected="files inside the release's folder",
            )  # fmt: skip
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with (
                open_regular(folder / entry.name, links=False) as source,
                target.open("wb") as sink,
            ):
                shutil.copyfileobj(source, sink)
        except OSError as error:
            raise PathError(f"cannot be copied: {error.strerror}", path=target) from None
        if file_sha256(target) != entry.sha256:
            raise ReleaseError(
                "not the file that was signed",
                path=folder / entry.name,
                expected="the release as it was written; pytest-twin verify says more",
            )
    if not (into / FILE_NAME).is_file():
        raise ReleaseError(
            f"a release without {FILE_NAME}", path=folder, expected="a release of a twin"
        )


def read_authentic(folder: Path, now: datetime) -> Release:
    """Read a release that is signed by a trusted key and undamaged; it may have expired.

    Raises:
        ReleaseError: it is damaged, not signed, or signed by an untrusted key.
    """
    verdict = check(folder, now=now)
    problems = [p.text for p in verdict.problems if p.code not in AGE_CODES]
    if verdict.release is None or problems:
        raise ReleaseError(
            f"the release does not hold: {problems[0] if problems else 'it is not signed'}",
            path=folder,
            expected="a release that pytest-twin verify accepts",
        )
    return verdict.release
