"""Find the files in a delivery that commands of pytest-twin wrote: they are not the supplier's.

This module runs in the child process, because it reads untrusted files.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any

from pytest_twin.asset import manifest
from pytest_twin.errors import TwinError
from pytest_twin.formats import results
from pytest_twin.formats.paths import read_bytes

_AUDIT = (".audit.html", ".audit.json")
_RELEASE = "release.dsse.json"
_LOCAL = ".twin"
_SCHEMA_IDS = "urn:pytest-twin:"
_GENERATOR = b'<meta name="generator" content="pytest-twin">'
_SCHEMA_LINE = b"# yaml-language-server: $schema="
_SCHEMA_NAMES = (b"twin.schema.json", b"golden.schema.json")
_MAX_JSON_BYTES = 16 * 2**20
"""Largest size of a JSON file that is compared with the layouts of results."""
_HEAD_BYTES = 4096
"""Number of bytes at the beginning of a page or spec that name what wrote it."""
_REPORT_KEYS = (
    frozenset({"schema", "command", "changes", "flags"}),
    frozenset({"schema", "robot", "conversions", "critical"}),
)
"""Fields of the change log and of the loss matrix of ``realize``."""
_MIN_KEYS = 3
"""Layouts with fewer required fields do not identify a file."""


def own_files(folder: Path, names: Iterable[str]) -> set[str]:
    """Return those of ``names`` below ``folder`` that commands of pytest-twin wrote."""
    listed = set(names)
    layouts = _layouts()
    own: set[str] = set()
    for name in listed:
        path = PurePosixPath(name)
        if name.endswith(_AUDIT) or _LOCAL in path.parts or path.name == results.MANIFEST:
            own.add(name)
        elif path.name == _RELEASE:
            own |= {other for other in listed if PurePosixPath(other).is_relative_to(path.parent)}
        elif path.suffix == ".json":
            own |= _of_json(folder, name, layouts) & listed
        elif path.suffix in (".html", ".yaml") and _says_so(folder / name):
            own.add(name)
    # A page or text beside its data.
    stems = {PurePosixPath(name).with_suffix("") for name in own if name.endswith(".json")}
    own |= {
        name
        for name in listed
        if (path := PurePosixPath(name)).suffix in (".html", ".md")
        and path.with_suffix("") in stems
    }
    return own


def _layouts() -> tuple[frozenset[str], ...]:
    """Required fields of every result that a command writes as JSON."""
    folder = resources.files("pytest_twin") / "schemas" / "results"
    required = [
        frozenset(json.loads(file.read_text("utf-8")).get("required", ()))
        for file in folder.iterdir()
        if file.name.endswith(".json")
    ]
    return (*(keys for keys in required if len(keys) >= _MIN_KEYS), *_REPORT_KEYS)


def _of_json(folder: Path, name: str, layouts: Iterable[frozenset[str]]) -> set[str]:
    """Return ``name`` if it is a result or schema; with a manifest also the generated files."""
    try:
        data = json.loads(read_bytes(folder / name, _MAX_JSON_BYTES))
    except (TwinError, ValueError, RecursionError):
        return set()
    if not isinstance(data, dict):
        return set()
    if str(data.get("$id", "")).startswith(_SCHEMA_IDS):
        return {name}
    keys = data.keys()
    if PurePosixPath(name).name == manifest.FILE_NAME and {"schema", "asset", "states"} <= keys:
        return {name, *_generated(PurePosixPath(name).parent, data["states"])}
    return {name} if any(layout <= keys for layout in layouts) else set()


def _generated(at: PurePosixPath, states: Any) -> set[str]:
    names: set[str] = set()
    for state in manifest.STATES[1:]:
        content = states.get(state) if isinstance(states, dict) else None
        if isinstance(content, dict) and isinstance(content.get("files"), dict):
            names |= {str(at / file) for file in content["files"]}
            reports = content.get(manifest.REPORTS)
            if isinstance(reports, list):
                names |= {str(at / file) for file in reports if isinstance(file, str)}
    return names


def _says_so(path: Path) -> bool:
    """Whether the beginning of a page or spec names pytest-twin."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError:
        return False
    first = head.partition(b"\n")[0].rstrip()
    return _GENERATOR in head or (
        first.startswith(_SCHEMA_LINE) and first.rpartition(b"/")[2] in _SCHEMA_NAMES
    )
