"""Find the twins of a pytest run from its arguments, before the collection."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from pytest_twin.gate.specs import GOLDEN_FOLDER, is_reserved
from pytest_twin.session.result_folders import is_fitted_model
from pytest_twin.twin import FILE_NAME, find_twin


def twin_files(
    arguments: Iterable[Path], config: pytest.Config, *, include_above: bool
) -> tuple[Path, ...]:
    """All ``twin.yaml`` files at, above or below the ``arguments``, sorted by path.

    Args:
        arguments: files and folders from the command line.
        include_above: whether to include a twin above an argument that contains none of its specs.
    """
    found: set[Path] = set()
    for argument in arguments:
        start = Path(os.path.normpath(config.invocation_params.dir / argument))
        above = find_twin(start if start.is_dir() else start.parent)
        if above is not None and (include_above or _reaches_specs(start, above.parent)):
            found.add(above)
        if start.is_dir():
            found.update(_below(start, config.getini("norecursedirs")))
    return tuple(sorted(found))


def _reaches_specs(start: Path, root: Path) -> bool:
    return start == root or GOLDEN_FOLDER in (root.name, *start.relative_to(root).parts)


def _below(start: Path, skipped: list[str]) -> Iterator[Path]:
    for here, folders, files in os.walk(start):
        has_twin = FILE_NAME in files and not is_fitted_model(Path(here) / FILE_NAME)
        if has_twin:
            yield Path(here) / FILE_NAME
        folders[:] = [
            name
            for name in folders
            if not any(fnmatch.fnmatch(name, pattern) for pattern in skipped)
            and not is_reserved(Path(here) / name)
        ]
