"""The manifest of an asset: its states (source, normalized, realization) with digests."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from pytest_twin.dependency import canonical
from pytest_twin.errors import FormatError, PathError
from pytest_twin.formats import atomic
from pytest_twin.formats.digest import bytes_sha256, file_sha256
from pytest_twin.formats.paths import decode_text, read_bytes

FILE_NAME = "manifest.json"
SOURCE_FOLDER = "source"
"""Folder of the supplier's unchanged files, next to the manifest."""
STATES = ("source", "normalized", "realization")
_MAX_BYTES = 64 * 2**20
"""Largest size of a manifest."""


@dataclass(frozen=True, slots=True)
class State:
    """One state of an asset.

    Attributes:
        files: path relative to the manifest, with ``/`` -> SHA-256.
        facts: further JSON fields, such as the supplier or the engine that produced the state.
    """

    files: Mapping[str, str]
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Return the SHA-256 over the paths and digests of all files, hex."""
        return bytes_sha256(canonical(dict(self.files)))


@dataclass(frozen=True, slots=True)
class Manifest:
    """States of one asset; states that it has not reached are omitted."""

    asset: str
    states: Mapping[str, State] = field(default_factory=dict)

    def to_text(self) -> str:
        """Return JSON text that depends on the content only."""
        data = {
            "schema": 1,
            "asset": self.asset,
            "states": {
                name: {
                    "digest": self.states[name].digest,
                    **self.states[name].facts,
                    "files": dict(sorted(self.states[name].files.items())),
                }
                for name in STATES
                if name in self.states
            },
        }
        return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def state_of(folder: Path, files: Iterable[Path], facts: Mapping[str, Any] | None = None) -> State:
    """Build the state of ``files`` below ``folder``.

    Raises:
        PathError: a file is missing or not a regular file.
    """
    return State(
        {path.relative_to(folder).as_posix(): file_sha256(path) for path in files}, facts or {}
    )


def write(path: Path, manifest: Manifest) -> None:
    """Write a manifest atomically."""
    atomic.write_text(path, manifest.to_text())


def read(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        PathError: missing, or not a regular file.
        FormatError: not a manifest, or a digest that differs from that of its files.
    """
    text = decode_text(read_bytes(path, _MAX_BYTES), path)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"not JSON: {error}", path=path) from None
    if not isinstance(data, dict) or data.get("schema") != 1:
        raise FormatError("not a manifest of an asset", path=path, expected='"schema": 1')
    states = data.get("states")
    if not isinstance(states, dict) or not isinstance(data.get("asset"), str):
        raise FormatError("no states", path=path, where="states", expected="a table")
    found: dict[str, State] = {}
    for name, content in states.items():
        where = f"states.{name}"
        files = content.get("files") if isinstance(content, dict) else None
        if name not in STATES or not isinstance(files, dict) or not _are_files(files):
            raise FormatError(
                "not a state", path=path, where=where, expected="paths and their SHA-256"
            )
        facts = {key: value for key, value in content.items() if key not in ("digest", "files")}
        state = State(files, facts)
        if content.get("digest") != state.digest:
            raise FormatError(
                "the digest does not follow from the files",
                path=path,
                where=f"{where}.digest",
                value=content.get("digest"),
                expected=state.digest,
            )
        found[name] = state
    return Manifest(data["asset"], found)


def _are_files(files: dict[str, Any]) -> bool:
    for name, digest in files.items():
        place = PurePosixPath(name)
        if place.is_absolute() or ".." in place.parts or not place.parts or "\0" in name:
            return False
        if not isinstance(digest, str) or len(digest) != 64:
            return False
    return True


def changes_of_source(path: Path, manifest: Manifest) -> list[str]:
    """Return changes of the source since intake, one line each; empty if it is elsewhere.

    Args:
        path: path of the manifest.
        manifest: its content.
    """
    source = manifest.states.get("source")
    if source is None or source.facts.get("folder") != SOURCE_FOLDER:
        return []
    folder, found = path.parent, []
    for name, digest in source.files.items():
        try:
            if file_sha256(folder / name) != digest:
                found.append(f"{name} was changed")
        except PathError as error:
            found.append(f"{name}: {error.problem}")
    for file in sorted((folder / SOURCE_FOLDER).rglob("*")):
        name = file.relative_to(folder).as_posix()
        if (file.is_symlink() or not file.is_dir()) and name not in source.files:
            found.append(f"{name} was added")
    return found


def find(path: Path) -> tuple[Path, Manifest] | None:
    """Find the manifest in a parent folder that lists a file in one of its states.

    Raises:
        FormatError: a manifest in a parent folder cannot be read.
    """
    for folder in path.parents:
        candidate = folder / FILE_NAME
        if not candidate.is_file() or candidate.is_symlink():
            continue
        try:
            manifest = read(candidate)
        except FormatError:
            if (folder / SOURCE_FOLDER).is_dir():
                raise
            # Other tools also write files of this name.
            continue
        name = path.relative_to(folder).as_posix()
        if any(name in state.files for state in manifest.states.values()):
            return candidate, manifest
    return None
