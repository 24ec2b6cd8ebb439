"""Read a release and its neighbours from the disk, and verify it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from securesystemslib.signer import Key

from pytest_twin.errors import LimitError, PathError, ReleaseError, TwinError
from pytest_twin.formats import yaml
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.release import accepted_releases
from pytest_twin.release import folder as folders
from pytest_twin.release import keys as trusted_keys
from pytest_twin.release.statement import Release
from pytest_twin.release.verify import (
    NOTHING_SIGNED,
    Circumstances,
    ReleaseProblem,
    Verdict,
    authenticate,
    judge,
)
from pytest_twin.twin import FILE_NAME

# Largest number of envelopes that are read to find an authentic neighbour, so that forged ones
# cannot cost much time.
_NEIGHBOURS = 16
AGE_CODES = ("expired", "rollback")
"""Codes of problems that come only from the age of a release."""


@dataclass(frozen=True, slots=True)
class Baseline:
    """Release with which the gate compares the present twin.

    Attributes:
        release: the newest valid release, or None.
        known: the newest authentic release, which may have expired or have damaged files. It
            states which goldens existed.
        problems: why newer releases are not valid; the gate shows them.
    """

    release: Release | None
    known: Release | None
    problems: tuple[str, ...]


def check(
    release: Path, *, keys: Path | None = None, now: datetime | None = None, remember: bool = False
) -> Verdict:
    """Verify the release in a folder.

    Args:
        keys: folder of trusted public keys; ``keys/`` of the twin if None.
        now: time for the verification; the present time if None.
        remember: whether to compare it with the releases accepted before on this machine, and to
            record it if it is valid.

    Raises:
        ReleaseError, PathError: the keys or the record of accepted releases cannot be read.
    """
    release = Path(os.path.abspath(release))  # noqa: PTH100 (takes '..' out, follows no link)
    root = release.parent.parent
    # A folder named on the command line may be a link, one of the twin may not.
    given = keys.resolve() if keys is not None else root / trusted_keys.FOLDER
    trusted = trusted_keys.load_trusted(given)
    return _check(release, root, trusted, now or datetime.now(UTC), remember)


def newest(root: Path) -> Path | None:
    """Folder of the release with the highest number, which need not be valid; None without any."""
    found = folders.numbered_releases(root / folders.RELEASES)
    return found[0][1] if found else None


def baseline(root: Path, *, now: datetime | None = None) -> Baseline:
    """Find the newest valid release of a twin.

    Args:
        root: the twin's folder.
        now: time for the verification; the present time if None.

    Raises:
        ReleaseError, PathError: the keys cannot be read.
    """
    trusted = trusted_keys.load_trusted(root / trusted_keys.FOLDER)
    known: Release | None = None
    problems: list[str] = []
    for number, path in folders.numbered_releases(root / folders.RELEASES)[:_NEIGHBOURS]:
        verdict = _check(path, root, trusted, now or datetime.now(UTC), remember=False)
        known = known or verdict.release
        if verdict.holds:
            return Baseline(verdict.release, known, tuple(problems))
        problems.extend(f"release {number} does not hold: {p.text}" for p in verdict.problems)
    return Baseline(None, known, tuple(problems))


def _check(
    path: Path, root: Path, trusted: Sequence[Key], now: datetime, remember: bool
) -> Verdict:
    if path.is_symlink():
        return Verdict(
            None, (ReleaseProblem("files", f"{path.name}: a link, not the release itself"),)
        )
    try:
        data = folders.read_envelope(path)
        listing = folders.listing(path)
    except (PathError, LimitError) as error:
        return Verdict(None, (ReleaseProblem("files", str(error)),))
    if data is None:
        return NOTHING_SIGNED
    try:
        release = authenticate(data, trusted)
    except ReleaseError as error:
        return Verdict(None, (ReleaseProblem("envelope" if trusted else "keys", str(error)),))
    try:
        twin = _stated_name(root) if path.parent.name == folders.RELEASES else None
    except TwinError as error:
        unnamed = f"its twin cannot be read, so that the twin's name is not checked: {error}"
        return Verdict(release, (ReleaseProblem("twin", unnamed),))
    circumstances = _circumstances(path, twin, trusted, release, remember)
    verdict = judge(release, listing, now=now, circumstances=circumstances)
    if remember and verdict.holds:
        accepted_releases.remember(release.header.series, release.number)
    return verdict


def _circumstances(
    path: Path, twin: str | None, trusted: Sequence[Key], release: Release, remember: bool
) -> Circumstances:
    number = folders.number_of(path)
    neighbours = [] if number is None else folders.numbered_releases(path.parent)
    newer = [entry for entry in neighbours if number is not None and entry[0] > number]
    older = [entry for entry in neighbours if number is not None and entry[0] < number]
    return Circumstances(
        folder_number=number,
        twin=twin,
        newer=_first_authentic(newer, trusted),
        before=None if _follows(release, older) else _first_authentic(older, trusted),
        seen=accepted_releases.highest(release.header.series) if remember else None,
    )


def _follows(release: Release, older: Sequence[tuple[int, Path]]) -> bool:
    """Whether the digest of the previous release equals the one that the release states."""
    previous = release.header.previous
    if previous is None or not older or older[0][0] != previous.number:
        return False
    try:
        data = folders.read_envelope(older[0][1])
    except TwinError:
        return False
    return data is not None and bytes_sha256(data) == previous.sha256


def _first_authentic(entries: Sequence[tuple[int, Path]], trusted: Sequence[Key]) -> Release | None:
    for number, path in entries[:_NEIGHBOURS]:
        try:
            data = folders.read_envelope(path)
            release = None if data is None else authenticate(data, trusted)
        except TwinError:
            continue
        if release is not None and release.number == number:
            return release
    return None


def _stated_name(root: Path) -> str | None:
    """The name stated in ``twin.yaml``, or None.

    Without a stated name, the twin has the name of its folder, which may differ between copies, so
    that the name in a release is not checked.

    Raises:
        TwinError: ``twin.yaml`` cannot be read.
    """
    if not os.path.lexists(root / FILE_NAME):
        return None
    data = yaml.load(root / FILE_NAME).data
    name = data.get("name") if isinstance(data, dict) else None
    return name if isinstance(name, str) else None
