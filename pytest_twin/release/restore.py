"""Files of a release, put back to where the twin has them."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pytest_twin.errors import PathError, ReleaseError, TwinError
from pytest_twin.formats import atomic
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.paths import open_regular
from pytest_twin.release import folder as folders
from pytest_twin.release.check import OF_THE_PAST, check
from pytest_twin.release.statement import FileEntry, Release
from pytest_twin.release.verify import FILES
from pytest_twin.twin import FILE_NAME

KEPT = ".twin/before-rollback"
"""Where the files that a rollback replaces are kept, in a folder for each."""


@dataclass(frozen=True, slots=True)
class Restored:
    """What a rollback did.

    Attributes:
        release: whose files the twin has now.
        replaced: paths in the twin's folder that were written.
        kept: the folder with what they were before, None where none existed.
    """

    release: Release
    replaced: tuple[str, ...]
    kept: Path | None


def place_of(entry: FileEntry) -> str | None:
    """Path in the twin's folder of a released file; None for results and report."""
    if not entry.name.startswith(f"{FILES}/"):
        return None
    return entry.original or entry.name.removeprefix(f"{FILES}/")


def copy_files(release: Release, folder: Path, into: Path) -> None:
    """Copy the files of a release to where its ``twin.yaml`` expects them, below ``into``.

    Every copy is compared with the signed digest.

    Raises:
        ReleaseError: a file is not what was signed, or there is no ``twin.yaml``.
        PathError: a file is missing, or cannot be copied.
    """
    for entry in release.files:
        place = place_of(entry)
        if place is None:
            continue
        target = into / place
        if not target.resolve().is_relative_to(into.resolve()):
            raise ReleaseError(
                "a file that leaves its folder", path=folder, value=place,
                expected="files inside the release's folder",
            )  # fmt: skip
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with open_regular(folder / entry.name) as source, target.open("wb") as sink:
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


def last_validated(root: Path, now: datetime) -> Path:
    """The newest release of a twin that is signed, undamaged and not what the twin has today.

    Raises:
        ReleaseError: there is none; the message lists why each was refused.
    """
    refused: list[str] = []
    for number, folder in folders.numbered(root / folders.RELEASES):
        try:
            release = authentic(folder, now)
        except TwinError as error:
            refused.append(f"release {number}: {error}")
            continue
        if any(_differs(entry, root) for entry in release.files):
            return folder
        refused.append(f"release {number}: the twin's files are already those of this release")
    raise ReleaseError(
        "no release to go back to",
        path=root / folders.RELEASES,
        value="; ".join(refused) or None,
        expected="a signed release whose files differ from today's",
    )


def authentic(folder: Path, now: datetime) -> Release:
    """A release that is signed by a trusted key and undamaged, of whatever age.

    Raises:
        ReleaseError: it is not; also where nothing is signed.
    """
    verdict = check(folder, now=now)
    problems = [p.text for p in verdict.problems if p.code not in OF_THE_PAST]
    if verdict.release is None or problems:
        raise ReleaseError(
            f"the release does not hold: {problems[0] if problems else 'it is not signed'}",
            path=folder,
            expected="a release that pytest-twin verify accepts",
        )
    return verdict.release


def restore(root: Path, folder: Path, *, now: datetime | None = None) -> Restored:
    """Give a twin the files of a release again.

    All files are copied and checked before the first is replaced; each is replaced whole, with
    ``twin.yaml`` the last. What they were before is kept.

    Args:
        root: the twin's folder.
        folder: of the release.
        now: the time; the clock's if None.

    Raises:
        ReleaseError: the release is unsigned, damaged, or by a key that is not trusted.
        PathError: a file cannot be written.
    """
    now = now or datetime.now(UTC)
    release = authentic(folder, now)
    changed = [entry for entry in release.files if _differs(entry, root)]
    kept = root / KEPT / now.strftime("%Y%m%dT%H%M%SZ")
    with tempfile.TemporaryDirectory(prefix="twin-") as scratch:
        copy_files(release, folder, Path(scratch))
        places = sorted(
            (place for entry in changed if (place := place_of(entry)) is not None),
            key=lambda place: (place == FILE_NAME, place),
        )
        saved = _keep(root, places, kept)
        for place in places:
            target = root / place
            atomic.make_folder(target.parent)
            with (
                (Path(scratch) / place).open("rb") as source,
                atomic.open_replacement(target) as sink,
            ):
                shutil.copyfileobj(source, sink)
    return Restored(release, tuple(places), kept if saved else None)


def _differs(entry: FileEntry, root: Path) -> bool:
    place = place_of(entry)
    if place is None:
        return False
    try:
        return file_sha256(root / place) != entry.sha256
    except TwinError:
        return True


def _keep(root: Path, places: Sequence[str], kept: Path) -> bool:
    """Copy what is about to be replaced; whether there was anything."""
    there = [place for place in places if (root / place).is_file()]
    for place in there:
        target = kept / place
        atomic.make_folder(target.parent)
        with open_regular(root / place) as source, atomic.open_replacement(target) as sink:
            shutil.copyfileobj(source, sink)
    return bool(there)
