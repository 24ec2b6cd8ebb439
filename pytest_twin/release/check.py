"""Reads a release and its neighbours from the disk, and verifies it with ``verify``."""

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
from pytest_twin.release import folder as folders
from pytest_twin.release import keys as trusted_keys
from pytest_twin.release import seen
from pytest_twin.release.statement import Release
from pytest_twin.release.verify import (
    NOTHING_SIGNED,
    Circumstances,
    Problem,
    Verdict,
    authenticate,
    judge,
)
from pytest_twin.twin import FILE_NAME

# Envelopes that are opened to find an authentic neighbour; forged ones cost time only.
_NEIGHBOURS = 16
OF_THE_PAST = ("expired", "rollback")
"""Codes of problems that a release has with age alone."""


@dataclass(frozen=True, slots=True)
class Baseline:
    """What the gate compares today with.

    Attributes:
        release: the newest release that holds, None where none does.
        known: the newest authentic release, whether or not it holds: expired, or its files
            damaged. Its goldens existed.
        problems: why newer ones, or all, do not hold; to be said loudly.
    """

    release: Release | None
    known: Release | None
    problems: tuple[str, ...]


def check(
    release: Path, *, keys: Path | None = None, now: datetime | None = None, remember: bool = False
) -> Verdict:
    """Whether the release in a folder holds.

    Args:
        release: the folder.
        keys: folder of trusted public keys; the twin's own ``keys/`` if None.
        now: the time to judge at; the clock's if None.
        remember: compare it with the releases accepted here before, and record it if valid.

    Raises:
        ReleaseError, PathError: the keys or what was remembered cannot be read.
    """
    release = Path(os.path.abspath(release))  # noqa: PTH100 (takes '..' out, follows no link)
    root = release.parent.parent
    trusted = trusted_keys.load_trusted(keys if keys is not None else root / trusted_keys.FOLDER)
    return _check(release, root, trusted, now or datetime.now(UTC), remember)


def newest(root: Path) -> Path | None:
    """The folder of a twin's release with the highest number, whether or not it holds."""
    found = folders.numbered(root / folders.RELEASES)
    return found[0][1] if found else None


def baseline(root: Path, *, now: datetime | None = None) -> Baseline:
    """The newest release of a twin that holds.

    Args:
        root: the twin's folder.
        now: the time to judge at; the clock's if None.

    Raises:
        ReleaseError, PathError: the keys cannot be read.
    """
    trusted = trusted_keys.load_trusted(root / trusted_keys.FOLDER)
    known: Release | None = None
    problems: list[str] = []
    for number, path in folders.numbered(root / folders.RELEASES)[:_NEIGHBOURS]:
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
        return Verdict(None, (Problem("files", f"{path.name}: a link, not the release itself"),))
    try:
        data = folders.read_envelope(path)
        listing = folders.listing(path)
    except (PathError, LimitError) as error:
        return Verdict(None, (Problem("files", str(error)),))
    if data is None:
        return NOTHING_SIGNED
    try:
        release = authenticate(data, trusted)
    except ReleaseError as error:
        return Verdict(None, (Problem("envelope" if trusted else "keys", str(error)),))
    circumstances = _circumstances(path, root, trusted, release, remember)
    verdict = judge(release, listing, now=now, circumstances=circumstances)
    if remember and verdict.holds:
        seen.remember(release.header.series, release.number)
    return verdict


def _circumstances(
    path: Path, root: Path, trusted: Sequence[Key], release: Release, remember: bool
) -> Circumstances:
    number = folders.number_of(path)
    neighbours = [] if number is None else folders.numbered(path.parent)
    newer = [entry for entry in neighbours if number is not None and entry[0] > number]
    older = [entry for entry in neighbours if number is not None and entry[0] < number]
    return Circumstances(
        folder_number=number,
        twin=_stated_name(root) if path.parent.name == folders.RELEASES else None,
        newer=_first_authentic(newer, trusted),
        before=None if _follows(release, older) else _first_authentic(older, trusted),
        seen=seen.highest(release.header.series) if remember else None,
    )


def _follows(release: Release, older: Sequence[tuple[int, Path]]) -> bool:
    """Whether the nearest older neighbour is, byte by byte, the one that the release follows."""
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
    """The name in ``twin.yaml``. Without one a twin is called as its folder, which may differ
    from place to place, and nothing is expected of its releases."""
    try:
        data = yaml.load(root / FILE_NAME).data
    except TwinError:
        return None
    name = data.get("name") if isinstance(data, dict) else None
    return name if isinstance(name, str) else None
