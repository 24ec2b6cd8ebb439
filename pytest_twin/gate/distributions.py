"""Versions and digests of installed distributions."""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import json
from collections.abc import Iterable, Iterator
from importlib import metadata
from itertools import islice
from pathlib import Path

from pytest_twin.formats.digest import file_sha256

_SOURCES_COUNT = 20_000
"""Largest number of source files that are hashed of one distribution."""


def installed_version(distribution: str) -> str:
    """Version of an installed distribution, ``absent`` where it is not installed.

    The source of an editable installation changes without its version, so that its digest follows.
    """
    try:
        version, installed = metadata.version(distribution), metadata.distribution(distribution)
    except metadata.PackageNotFoundError:
        return "absent"
    if not _is_editable(installed):
        return version
    return f"{version} editable {_sources_sha256(_top_modules(installed))[:12]}"


def code_sha256(distribution: metadata.Distribution, modules: Iterable[str]) -> str:
    """SHA-256 of the code of a distribution, hex.

    Args:
        modules: names of its modules, for one that does not record the digests of its files.
    """
    record = distribution.read_text("RECORD")
    if record is None or _is_editable(distribution):
        return _sources_sha256({*modules, *_top_modules(distribution)})
    # Scripts contain the path of the environment, and so differ from machine to machine.
    code = sorted(
        (row[0], row[1])
        for row in csv.reader(record.splitlines())
        if len(row) > 1 and row[1] and not row[0].startswith("..")
        and not row[0].partition("/")[0].endswith(".dist-info")
    )  # fmt: skip
    return hashlib.sha256(json.dumps(code).encode()).hexdigest()


def _is_editable(distribution: metadata.Distribution) -> bool:
    text = distribution.read_text("direct_url.json")
    try:
        return bool(json.loads(text or "{}").get("dir_info", {}).get("editable"))
    except (ValueError, AttributeError):
        return False


def _top_modules(distribution: metadata.Distribution) -> list[str]:
    """Top-level modules, as far as the distribution lists them."""
    return (distribution.read_text("top_level.txt") or "").split()


def _sources_sha256(modules: Iterable[str]) -> str:
    hashed = hashlib.sha256()
    for name in sorted({module.partition(".")[0] for module in modules}):
        for path in islice(_sources(name), _SOURCES_COUNT):
            hashed.update(f"{name} {path.name} {file_sha256(path)}\n".encode())
    return hashed.hexdigest()


def _sources(module: str) -> Iterator[Path]:
    """Source files of a top-level module, sorted."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return
    if spec is None:
        return
    for folder in spec.submodule_search_locations or ():
        yield from sorted(Path(folder).rglob("*.py"))
    if not spec.submodule_search_locations and spec.origin and Path(spec.origin).is_file():
        yield Path(spec.origin)
