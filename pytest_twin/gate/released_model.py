"""The release of the twin that earlier recordings are compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.recordings import mcap, sqlite
from pytest_twin.formats.recordings.csv_dialect import GZIP_SUFFIX
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.release.check import baseline
from pytest_twin.release.environment import engine_changes
from pytest_twin.release.folder import RELEASES
from pytest_twin.release.restore import place_of
from pytest_twin.release.rollback import changed_files
from pytest_twin.release.statement import FileEntry, Release
from pytest_twin.twin import FILE_NAME

_RECORDINGS = (*mcap.SUFFIXES, *sqlite.SUFFIXES, ".csv", GZIP_SUFFIX, ".parquet")
"""Endings of recordings."""


@dataclass(frozen=True, slots=True)
class Released:
    """A release beside the earlier recordings.

    Attributes:
        release: the newest valid release.
        number: its number if the earlier recordings are files of it, else None.
        notes: recordings that are missing or have another digest, and changed engines.
        changes: changed files of the model.
    """

    release: Release
    number: int | None
    notes: tuple[str, ...]
    changes: tuple[str, ...]


def released_beside(model: Path, before: Sequence[Path]) -> Released | None:
    """The newest valid release of a twin; None for another model or without a release.

    Args:
        model: the file of MODEL.
        before: earlier recordings.

    Raises:
        ReleaseError, PathError: the keys or a file of the twin cannot be read.
    """
    root = model.parent
    if model.name != FILE_NAME or not (root / RELEASES).is_dir():
        return None
    found = baseline(root).release
    if found is None:
        return None
    recordings = _recordings_of(found)
    digests = {e.sha256 for e in recordings.values()}
    by_name = {Path(p).name: p for p in recordings}
    notes, proved = list[str](), 0
    for path in before:
        if not path.is_file():
            continue
        if file_sha256(path) in digests:
            proved += 1
        elif path.name in by_name:
            notes.append(
                f"{path.name} is not the recording that proved release {found.number}: its digest "
                "differs; it is compared as a recording of its own"
            )
    changed = changed_files(root, found)
    notes += [
        f"{c.path}, which proved release {found.number}, "
        f"{'is missing' if c.before is None else 'was replaced: its digest differs'}"
        for c in changed if c.path in recordings
    ]  # fmt: skip
    notes += engine_changes(found)
    models = tuple(
        c.path for c in changed if c.path not in recordings and not c.path.startswith("golden/")
    )
    return Released(found, found.number if proved == len(before) else None, tuple(notes), models)


def reference_recordings(root: Path, released: Release, folder: Path) -> list[Path]:
    """Recordings that proved a release: its copies, else unchanged files of the twin.

    Args:
        root: folder of the twin.
        folder: copy of the release's files.
    """
    found = []
    for place, entry in _recordings_of(released).items():
        candidates = (folder / place, root / place)
        found += [p for p in candidates if p.is_file() and file_sha256(p) == entry.sha256][:1]
    return found


def _recordings_of(released: Release) -> dict[str, FileEntry]:
    """Path in the twin's folder -> entry of each recording of a release."""
    entries = {place_of(e) or e.name: e for e in (*released.files, *released.external)}
    return {p: e for p, e in entries.items() if p.lower().endswith(_RECORDINGS)}


def model_changes(
    model: Path, released_model: Path, sandbox: Sandbox, request: dict[str, Any]
) -> list[dict[str, Any]]:
    """Changed parts of the model with their share of the earlier recordings' error.

    Args:
        model: ``twin.yaml`` of today.
        released_model: ``twin.yaml`` of the release's copy.
        request: ``recordings``, ``topics`` and ``options`` of the comparison.

    Raises:
        TwinError: the release or a recording cannot be used.
    """
    changes: list[dict[str, Any]] = sandbox.call(
        "pytest_twin.changes.model_side:model_changes",
        {"today": str(model), "released": str(released_model), **request},
    )
    return changes
