"""What was read of a realization, kept between runs, so that an unchanged twin loads no simulator.

An entry holds as long as every byte that went into it is the same. It saves time and proves
nothing: whoever signs a release reads the model itself.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pytest_twin.dependency import Part, Structure
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.formats.digest import bytes_sha256, file_sha256
from pytest_twin.formats.paths import read_bytes
from pytest_twin.twin import Twin

FOLDER = ".twin/cache"
_MAX_BYTES = 256 * 2**20
_SCHEMA = 1


@dataclass(frozen=True, slots=True)
class Features:
    """What the dependency map knows of a realization.

    Attributes:
        parts: part id -> part.
        structure: how it hangs together.
        files: every file that the model was read from.
    """

    parts: Mapping[str, Part]
    structure: Structure
    files: tuple[Path, ...]

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
        return {
            "structure": self.structure.to_json(),
            "parts": {ident: part.content for ident, part in self.parts.items()},
            "files": [str(path) for path in self.files],
        }

    @classmethod
    def from_json(cls, data: object) -> Features:
        """The inverse of ``to_json``.

        Raises:
            ValueError: fields missing or of another shape.
        """
        if not isinstance(data, Mapping):
            raise ValueError("not a table")
        structure = Structure.from_json(data.get("structure"))
        parts, files = data.get("parts"), data.get("files")
        if not isinstance(parts, Mapping) or set(parts) != structure.part_ids:
            raise ValueError("not the parts of the structure")
        if not all(isinstance(content, Mapping) for content in parts.values()):
            raise ValueError("not the content of a part")
        if not isinstance(files, list) or not all(isinstance(path, str) for path in files):
            raise ValueError("not a list of files")
        return cls(
            {ident: Part(ident, content) for ident, content in parts.items()},
            structure,
            tuple(Path(path) for path in files),
        )


def features_of(
    twin: Twin,
    realization: str,
    read: Callable[[], object],
    versions: Mapping[str, str],
    *,
    fresh: bool = False,
) -> Features:
    """Features of a realization: from the cache where every byte behind them is unchanged.

    Args:
        twin: the twin.
        realization: a name in it.
        read: reads them from the model itself (in a child process), as ``Features.to_json``.
        versions: of the distributions that read a model, MuJoCo's among them.
        fresh: read them whatever the cache says.

    Raises:
        TwinError: what ``read`` raises.
        ValueError: ``read`` returned something else.
    """
    path = twin.root / FOLDER / f"{realization}.json"
    # The place too: a copied folder brings along an entry that speaks of the files it came from.
    place = str(twin.path)
    # A list of effects that came beside the model since is in no digest of the entry.
    beside = twin.realizations[realization].effects is not None
    key = {
        "schema": _SCHEMA,
        "reader": _reader(),
        "versions": dict(versions),
        "twin": place,
        "effects": beside,
    }
    found = None if fresh else _stored(path, key, realization)
    if found is not None:
        return found
    before = _digests((*_described(twin), twin.realizations[realization].file))
    features = Features.from_json(read())
    after = _digests((*_described(twin), *features.files))
    # A file that changed while it was read is in nobody's digest.
    if before is not None and after is not None and before.items() <= after.items():
        entry = {"key": key, "digests": after, "features": features.to_json()}
        text = json.dumps(entry, allow_nan=False, separators=(",", ":"))
        _store(path, {"sha256": bytes_sha256(text.encode()), "entry": text})
    return features


def _described(twin: Twin) -> tuple[Path, ...]:
    """Files that say how a model is to be read."""
    fit = () if twin.fit is None else (twin.fit.path,)
    return (twin.path, *fit, *(entry.record.path for entry in twin.fits))


def _stored(path: Path, key: Mapping[str, Any], realization: str) -> Features | None:
    try:
        envelope = json.loads(read_bytes(path, _MAX_BYTES))
        text = envelope["entry"]
        # Not against forgery: against a half-written or damaged file.
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


def _store(path: Path, envelope: Mapping[str, Any]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.parent.is_symlink() and not path.parent.parent.is_symlink():
            atomic.write_text(path, json.dumps(envelope))
    except (OSError, TwinError):
        # A twin that may not be written to is read each time.
        return


def _digests(paths: Iterable[Path]) -> dict[str, str] | None:
    try:
        return {str(path): file_sha256(path) for path in paths}
    except TwinError:
        return None


def reader_files() -> tuple[Path, ...]:
    """The code that reads a model: its change is a change of every entry."""
    realization = Path(__file__).parents[1]
    return (*sorted(realization.rglob("*.py")), realization.parent / "dependency.py")


@cache
def _reader() -> str:
    return bytes_sha256("".join(file_sha256(path) for path in reader_files()).encode())
