"""Pytest collectors and items of golden specs: a file, and one item per realization."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from pytest_twin.errors import TwinError
from pytest_twin.golden import Golden

if TYPE_CHECKING:
    from pytest_twin.gate.gate import Gate

Load = Callable[[], "tuple[Gate, Golden]"]
Run = Callable[["GoldenItem"], None]


class GoldenFailedError(Exception):
    """A golden that did not pass.

    Attributes:
        text: description of the failure, several lines.
        headline: one line, for places that also show the name of the golden.
        line: 1-based line in the spec of the exceeded tolerance.
    """

    def __init__(self, text: str, headline: str, line: int) -> None:
        super().__init__(headline)
        self.text = text
        self.headline = headline
        self.line = line


class FailureText:
    """Representation of a failure for pytest: full text, and one line for summaries and JUnit."""

    def __init__(self, text: str, headline: str, path: str, line: int) -> None:
        self.text = text
        self.reprcrash = SimpleNamespace(message=headline, path=path, lineno=line)

    def __str__(self) -> str:
        return self.text

    def toterminal(self, tw: Any) -> None:
        """Print the text."""
        for line in self.text.splitlines():
            tw.line(line)


class GoldenFile(pytest.File):
    """Collector of one golden spec."""

    @classmethod
    def of(cls, parent: pytest.Collector, *, path: Path, load: Load, run: Run) -> GoldenFile:
        """Create the collector of the spec at ``path``.

        Args:
            load: reads the spec and its twin.
        """
        file: GoldenFile = cls.from_parent(parent, path=path)
        file.load = load
        file.run = run
        return file

    load: Load
    run: Run

    def collect(self) -> list[pytest.Item]:
        """Return one item per realization.

        Raises:
            CollectError: the spec or its twin is not valid; one line.
        """
        try:
            gate, golden = self.load()
        except TwinError as error:
            raise self.CollectError(str(error)) from None
        return [
            GoldenItem.of(self, gate=gate, golden=golden, realization=realization)
            for realization in golden.realizations
        ]


class GoldenItem(pytest.Item):
    """One golden on one realization."""

    gate: Gate
    golden: Golden
    realization: str
    key: str
    run: Run
    outcome_json: str | None = None
    """The outcome as JSON, None before the run."""

    @classmethod
    def of(cls, parent: GoldenFile, *, gate: Gate, golden: Golden, realization: str) -> GoldenItem:
        """Create the item of ``golden`` on ``realization``."""
        name = f"{parent.path.stem}[{realization}]"
        # With an explicit node id pytest reads the brackets as parameters, and --lf works.
        item: GoldenItem = cls.from_parent(parent, name=name, nodeid=f"{parent.nodeid}::{name}")
        item.gate = gate
        item.golden = golden
        item.realization = realization
        item.key = f"{golden.id}@{realization}"
        item.run = parent.run
        for marker in (golden.kind, golden.criticality):
            item.add_marker(marker)
        return item

    def runtest(self) -> None:
        """Run the golden; a failure is raised as an exception."""
        self.run(self)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """The spec, and the line of its first field (0-based)."""
        return self.path, self.golden.lines.get("kind", 1) - 1, self.name

    def repr_failure(  # type: ignore[override]
        self, excinfo: pytest.ExceptionInfo[BaseException]
    ) -> Any:
        """Return the text of a golden that did not pass."""
        error = excinfo.value
        if isinstance(error, GoldenFailedError):
            return FailureText(error.text, error.headline, str(self.path), error.line)
        return super().repr_failure(excinfo)
