"""Code and settings of the process that runs the gate, which could change every verdict.

They are ``conftest.py`` files, modules that these import from the twin's folder, the configuration
of pytest, and its plugins. A golden depends on those that were there when it ran. One that was
added later cannot have changed its result.
"""

from __future__ import annotations

import configparser
import json
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.dependency import Part
from pytest_twin.errors import TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.paths import read_bytes

LAYER = "process:"
"""Layer of the parts that are files; the name is the path relative to the twin's folder."""
PLUGIN_LAYER = "plugin:"
"""Layer of the parts that are installed plugins of pytest; the name is that of the distribution."""
_CONFIGURATION_BYTES = 4 * 2**20
"""Largest size of a configuration file of pytest."""
_INI_SECTIONS = ("pytest", "tool:pytest")
_TOML_TABLES = (("pytest",), ("tool", "pytest"))


@dataclass(frozen=True)
class GateProcess:
    """Code and settings of the process of the gate.

    Attributes:
        parts: part id -> part, on which every golden depends that runs in the process.
        files: file -> SHA-256; test modules too, which no golden depends on.
        problems: reasons against a release, one line each.
    """

    parts: Mapping[str, Part] = field(default_factory=dict)
    files: Mapping[Path, str] = field(default_factory=dict)
    problems: tuple[str, ...] = ()

    def merged_with(self, other: GateProcess) -> GateProcess:
        """Both together; a part that changed in between is that of ``other``."""
        return GateProcess(
            {**self.parts, **other.parts},
            {**self.files, **other.files},
            tuple(dict.fromkeys((*self.problems, *other.problems))),
        )

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields, for the controller of pytest-xdist."""
        return {
            "parts": {ident: part.content for ident, part in self.parts.items()},
            "files": {str(path): sha256 for path, sha256 in self.files.items()},
            "problems": list(self.problems),
        }

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> GateProcess:
        """Read the fields that :meth:`to_json` gives."""
        return cls(
            {ident: Part(ident, content) for ident, content in fields["parts"].items()},
            {Path(path): sha256 for path, sha256 in fields["files"].items()},
            tuple(fields["problems"]),
        )


def file_part(root: Path, path: Path) -> Part:
    """Part of a file of code, or of a configuration file of pytest.

    Raises:
        TwinError: the file cannot be read.
    """
    ident = LAYER + Path(os.path.relpath(path, root)).as_posix()
    options = _options(path)
    return Part(ident, {"sha256": file_sha256(path)} if options is None else {"options": options})


def released_files(root: Path, parts: Mapping[str, Part]) -> GateProcess:
    """Present state of the files of the gate's process that a release depends on.

    Another selection of tests loads other files; those of the release are compared in any case.

    Args:
        root: the twin's folder.
    """
    now: dict[str, Part] = {}
    files: dict[Path, str] = {}
    for ident in parts:
        if not ident.startswith(LAYER):
            continue
        path = Path(os.path.normpath(root / ident.removeprefix(LAYER)))
        try:
            now[ident] = file_part(root, path)
            files[path] = file_sha256(path)
        except TwinError:
            # Without a part of this name, the goldens that depend on it are stale.
            continue
    return GateProcess(now, files)


def _options(path: Path) -> dict[str, Any] | None:
    """Options of pytest in a configuration file; None for a file of another kind."""
    try:
        if path.suffix == ".toml":
            data = tomllib.loads(read_bytes(path, _CONFIGURATION_BYTES).decode("utf-8"))
            tables = [_table(data, names) for names in _TOML_TABLES]
        elif path.suffix in (".ini", ".cfg"):
            parser = configparser.ConfigParser(interpolation=None, strict=False)
            parser.read_string(read_bytes(path, _CONFIGURATION_BYTES).decode("utf-8"))
            tables = [dict(parser[name]) for name in _INI_SECTIONS if parser.has_section(name)]
        else:
            return None
    except (ValueError, configparser.Error):
        return None
    return {
        name: json.loads(json.dumps(value, default=str))
        for options in tables
        for name, value in options.items()
    }


def _table(data: Mapping[str, Any], names: tuple[str, ...]) -> Mapping[str, Any]:
    for name in names:
        data = data.get(name, {})
        if not isinstance(data, Mapping):
            return {}
    return data
