"""Functions for the sandbox are imported from a folder outside the checkout."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="session", autouse=True)
def importable_functions(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with ``sandboxed.py``: children import nothing from pytest's own folder."""
    folder = tmp_path_factory.mktemp("functions")
    (folder / "sandboxed.py").write_bytes(Path(__file__).with_name("sandboxed.py").read_bytes())
    sys.path.append(str(folder))
    yield folder
    sys.path.remove(str(folder))
