"""Check that the files of a source asset have not changed since ``pytest-twin intake``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pytest_twin.asset import manifest
from pytest_twin.errors import TwinError
from pytest_twin.twin import Twin

_MAX_NAMED = 3
"""Largest number of changed files in a message."""


def changed_sources(twin: Twin) -> Iterator[str]:
    """Yield one line for each source asset of the twin that differs from its manifest."""
    seen: set[Path] = set()
    models = (reference.file for reference in twin.realizations.values())
    for file in dict.fromkeys((*twin.source, *models)):
        try:
            found = manifest.find(file)
            if found is None or found[0] in seen:
                continue
            seen.add(found[0])
            lines = manifest.changes_of_source(*found)
        except TwinError as error:
            yield str(error)
            continue
        if lines:
            more = len(lines) - _MAX_NAMED
            listed = "; ".join(lines[:_MAX_NAMED]) + (f"; and {more} more" if more > 0 else "")
            yield (
                f"{found[0]}: the source asset has changed since intake: {listed} "
                "(expected the files of the manifest; for new files run `pytest-twin intake`)"
            )
