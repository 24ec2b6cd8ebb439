"""Restore the files of a release in the twin's folder."""

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
from pytest_twin.release.check import AGE_CODES, check
from pytest_twin.release.statement import FileEntry, Release
from pytest_twin.release.verify import FILES
from pytest_twin.twin import FILE_NAME

KEPT = ".twin/before-rollback"
"""Folder that keeps the files replaced by rollbacks, in one folder for each rollback."""


@dataclass(frozen=True, slots=True)
class RollbackResult:
    """Result of a rollback.

    Attributes:
        release: the restored release.
        replaced: written files, relative to the twin's folder.
        kept: folder with the replaced files, None if none existed.
    """

    release: Release
    replaced: tuple[str, ...]
    kept: Path | None


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
    """The newest release that is signed, undamaged, and differs from the twin's present files.

    Raises:
        ReleaseError: there is none; the message states why each release was refused.
    """
    refused: list[str] = []
    for number, folder in folders.numbered_releases(root / folders.RELEASES):
        try:
            release = read_authentic(folder, now)
        except TwinError as error:
            refused.append(f"release {number}: {error}")
            continue
        if any(_differs(entry, root) for entry in release.files):
            return folder
        refused.append(f"release {number}: the twin's files are already those of this release")
    raise ReleaseError(
        "no release to restore",
        path=root / folders.RELEASES,
        value="; ".join(refused) or None,
        expected="a signed release whose files differ from today's",
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


def restore(root: Path, folder: Path, *, now: datetime | None = None) -> RollbackResult:
    """Restore the files of a release in a twin.

    All files are copied and checked before the first is replaced. Each file is replaced in one
    step, and ``twin.yaml`` last. The replaced files are kept.

    Args:
        root: the twin's folder.
        folder: folder of the release.
        now: time for the verification; the present time if None.

    Raises:
        ReleaseError: the release is unsigned, damaged, or by a key that is not trusted.
        PathError: a file cannot be written.
    """
    now = now or datetime.now(UTC)
    release = read_authentic(folder, now)
    changed = [entry for entry in release.files if _differs(entry, root)]
    kept = root / KEPT / now.strftime("%Y%m%dT%H%M%SZ")
    with tempfile.TemporaryDirectory(prefix="twin-") as scratch:
        copy_files(release, folder, Path(scratch))
        places = sorted(
            (place for entry in changed if (place := place_of(entry)) is not None),
            key=lambda place: (place == FILE_NAME, place),
        )
        saved = _keep_copies(root, places, kept)
        for place in places:
            target = root / place
            atomic.make_folder(target.parent)
            with (
                (Path(scratch) / place).open("rb") as source,
                atomic.open_replacement(target) as sink,
            ):
                shutil.copyfileobj(source, sink)
    return RollbackResult(release, tuple(places), kept if saved else None)


def _differs(entry: FileEntry, root: Path) -> bool:
    place = place_of(entry)
    if place is None:
        return False
    try:
        return file_sha256(root / place) != entry.sha256
    except TwinError:
        return True


def _keep_copies(root: Path, places: Sequence[str], kept: Path) -> bool:
    """Copy the files that will be replaced; whether any exists."""
    there = [place for place in places if (root / place).is_file()]
    for place in there:
        target = kept / place
        atomic.make_folder(target.parent)
        with open_regular(root / place) as source, atomic.open_replacement(target) as sink:
            shutil.copyfileobj(source, sink)
    return bool(there)
