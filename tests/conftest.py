"""Fixtures of several rooms."""

from __future__ import annotations

import os

# Before numpy is imported: with a thread on each core in each worker, waiting threads of OpenBLAS
# keep the cores busy, and an identification uses twenty times the processor time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import importlib
from collections.abc import Iterator
from typing import IO, Any

import pytest
from in_process import InProcess
from matplotlib.figure import Figure

from pytest_twin.cli import COMMANDS, module_of

# Imported here once: pytester unloads what an inner run imports, and msgspec looks the types of a
# statement up in its module when it first reads one.
from pytest_twin.release import statement

assert statement.read


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the long proofs; a shorter one of each kind, without the mark, always runs."""
    if os.environ.get("TWIN_NIGHTLY"):
        return
    long_proofs = [item for item in items if item.get_closest_marker("nightly")]
    items[:] = [item for item in items if not item.get_closest_marker("nightly")]
    if long_proofs:
        config.hook.pytest_deselected(items=long_proofs)


@pytest.fixture(scope="session", autouse=True)
def _environment_of_a_person() -> Iterator[None]:
    """Build machines set CI, where ``--twin-update`` refuses to run; the tests act as a person."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("CI", "TWIN_SIGNING_KEY"):
            patch.delenv(name, raising=False)
        yield


_RENDER = Figure.savefig
_EMPTY = {
    "svg": b'<svg xmlns="http://www.w3.org/2000/svg"></svg>',
    "png": b"\x89PNG\r\n\x1a\n",
}


def _leave_empty(figure: Figure, file: IO[bytes], *, format: str, **options: Any) -> None:
    """Write a figure without its content; what it would contain is drawn and not rendered."""
    file.write(_EMPTY[format])


@pytest.fixture(scope="session", autouse=True)
def _figures_not_rendered() -> Iterator[None]:
    """Figures are drawn and not rendered, which saves a quarter of the time of most commands.

    Modules about figures use ``rendered_figures``; commands in children render theirs.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", _leave_empty)
        yield


@pytest.fixture
def rendered_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are rendered, as everywhere outside the tests."""
    monkeypatch.setattr(Figure, "savefig", _RENDER)


@pytest.fixture(scope="module")
def commands_in_process() -> Iterator[None]:
    """Commands do their work in this process, because the start of a child takes 1 to 2 s.

    The children of commands are tested in ``tests/setup``, ``tests/realization/test_sandbox.py``
    and in modules without this fixture.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in (*COMMANDS, "child_result", "robot_audit"):
            command = importlib.import_module(module_of(name))
            if hasattr(command, "Sandbox"):
                patch.setattr(command, "Sandbox", InProcess)
        yield
