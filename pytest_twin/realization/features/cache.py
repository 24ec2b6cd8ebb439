"""Cache of the parts and structure of a realization, so that an unchanged twin loads no simulator.

An entry is valid as long as all files behind it are unchanged. The cache only saves time: before a
release is signed, the model is read again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from pytest_twin.dependency import Part, Structure
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.formats.digest import bytes_sha256, file_sha256
from pytest_twin.formats.paths import read_bytes
from pytest_twin.twin import RealizationRef, Twin

FOLDER = ".twin/cache"
_MAX_BYTES = 256 * 2**20
"""Largest size of a cached file."""
_SCHEMA = 2
"""Version of the cache's layout."""


@dataclass(frozen=True, slots=True)
class Features:
    """Parts, structure and files of a realization.

    Attributes:
        parts: part id -> part.
        structure: kinematic tree, actuators and couplings.
        files: all files that the model was read from.
        replaced: part id -> part, where a record or ``fit:`` replaces values of the model: with
            the model's own values.
    """

    parts: Mapping[str, Part]
    structure: Structure
    files: tuple[Path, ...]
    replaced: Mapping[str, Part] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON-able values."""
        return {
            "structure": self.structure.to_json(),
            "parts": {ident: part.content for ident, part in self.parts.items()},
            "files": [str(path) for path in self.files],
            "replaced": {ident: part.content for ident, part in self.replaced.items()},
        }

    @classmethod
    def from_json(cls, data: object) -> Features:
        """Build features from what :meth:`to_json` returned.

        Raises:
            ValueError: fields missing or of another shape.
        """
        if not isinstance(data, Mapping):
            raise ValueError("not a table")
        structure = Structure.from_json(data.get("structure"))
        parts, files, replaced = data.get("parts"), data.get("files"), data.get("replaced")
        if not isinstance(parts, Mapping) or set(parts) != structure.part_ids:
            raise ValueError("not the parts of the structure")
        if not isinstance(replaced, Mapping):
            raise ValueError("not a table of parts")
        if not all(isinstance(one, Mapping) for one in (*parts.values(), *replaced.values())):
            raise ValueError("not the content of a part")
        if not isinstance(files, list) or not all(isinstance(path, str) for path in files):
            raise ValueError("not a list of files")
        return cls(
            {ident: Part(ident, content) for ident, content in parts.items()},
            structure,
            tuple(Path(path) for path in files),
            {ident: Part(ident, content) for ident, content in replaced.items()},
        )


def features_of(
    twin: Twin,
    reference: RealizationRef,
    read: Callable[[], object],
    versions: Mapping[str, str],
    *,
    fresh: bool = False,
) -> Features:
    """Features of a realization, from the cache if all files behind them are unchanged.

    Args:
        reference: realization, or another model that a record was made with.
        read: reads the features from the model in a child process; returns ``Features.to_json``.
        versions: Python distribution that reads models, such as MuJoCo -> version.
        fresh: whether to ignore the cache.

    Raises:
        TwinError: an error of ``read``.
        ValueError: ``read`` returned another structure.
    """
    path = twin.root / FOLDER / f"{reference.name}.json"
    # The path is part of the key: the cache in a copied folder refers to the original files.
    place = str(twin.path)
    # An effects file that was added later is not among the digests of the entry.
    beside = reference.effects is not None
    key = {
        "schema": _SCHEMA,
        "reader": _reader(),
        "versions": dict(versions),
        "twin": place,
        "effects": beside,
    }
    found = None if fresh else _read_entry(path, key, reference.name)
    if found is not None:
        return found
    before = _digests((*_twin_files(twin), reference.file))
    features = Features.from_json(read())
    after = _digests((*_twin_files(twin), *features.files))
    # The entry is stored only if no file changed while it was read.
    if before is not None and after is not None and before.items() <= after.items():
        entry = {"key": key, "digests": after, "features": features.to_json()}
        text = json.dumps(entry, allow_nan=False, separators=(",", ":"))
        _write_entry(path, {"sha256": bytes_sha256(text.encode()), "entry": text})
    return features


def _twin_files(twin: Twin) -> tuple[Path, ...]:
    """Files of a twin that determine how its models are loaded."""
    tables = (table.path for table in twin.fit_tables)
    stated = () if twin.stated is None else (twin.stated.path,)
    calibrations = (entry.record.path for entry in twin.calibrations)
    return tuple(dict.fromkeys((twin.path, *tables, *stated, *calibrations)))


def _read_entry(path: Path, key: Mapping[str, Any], realization: str) -> Features | None:
    try:
        envelope = json.loads(read_bytes(path, _MAX_BYTES))
        text = envelope["entry"]
        # The digest detects a damaged file, not a forged one.
        if bytes_sha256(text.encode()) != envelope["sha256"]:
            return None
        entry = json.loads(text)
        digests = entry["digests"]
        if entry["key"] != key or _digests(map(Path, digests)) != digests:
            return None
        features = Features.from_json(entry["features"])
        unread = {str(path) for path in features.files} - set(digests)
    except (TwinError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return features if features.structure.realization == realization and not unread else None


def _write_entry(path: Path, envelope: Mapping[str, Any]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.parent.is_symlink() and not path.parent.parent.is_symlink():
            atomic.write_text(path, json.dumps(envelope))
    except (OSError, TwinError):
        # Without write access, the model is read at each run.
        return


def _digests(paths: Iterable[Path]) -> dict[str, str] | None:
    try:
        return {str(path): file_sha256(path) for path in paths}
    except TwinError:
        return None


def reader_files() -> tuple[Path, ...]:
    """Source files that read a model; a change of one invalidates all entries."""
    realization = Path(__file__).parents[1]
    return (*sorted(realization.rglob("*.py")), realization.parent / "dependency.py")


@cache
def _reader() -> str:
    return bytes_sha256("".join(file_sha256(path) for path in reader_files()).encode())
