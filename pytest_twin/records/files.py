"""Files that a record was made from, and the model that it was made with."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.errors import TwinError
from pytest_twin.formats.content_digest import content_digest
from pytest_twin.formats.digest import bytes_sha256, file_sha256
from pytest_twin.records.state import FileDigests
from pytest_twin.twin import RealizationRef, Twin


def file_digests(twin: Twin) -> FileDigests:
    """Digests of files inside the roots of a twin."""

    def content(path: Path) -> str | None:
        try:
            return content_digest(path) if twin.path_roots.contains(path) else None
        except TwinError:
            return None

    def sha256(path: Path) -> str | None:
        try:
            return file_sha256(path) if twin.path_roots.contains(path) else None
        except TwinError:
            return None

    return FileDigests(content, sha256)


def source_reference(twin: Twin, model: str | Path) -> RealizationRef:
    """A realization by its name, or another model by its path under a name of its own."""
    if isinstance(model, str):
        return twin.realizations[model]
    return RealizationRef(f"record-{bytes_sha256(str(model).encode())[:12]}", model)
