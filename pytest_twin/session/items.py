"""Golden specs as pytest sees them: a file, an item per realization, a failure in words."""

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
        text: what a person needs to act on it.
        headline: one line of it, for places that show the golden's name beside it.
        line: 1-based line in the spec that it is about.
    """

    def __init__(self, text: str, headline: str, line: int) -> None:
        super().__init__(headline)
        self.text = text
        self.headline = headline
        self.line = line


class FailureText:
    """What pytest prints of a failure: our text, and one line for summaries and JUnit."""

    def __init__(self, text: str, headline: str, path: str, line: int) -> None:
        self.text = text
        self.reprcrash = SimpleNamespace(message=headline, path=path, lineno=line)

    def __str__(self) -> str:
        return self.text

    def toterminal(self, tw: Any) -> None:
        """Print it."""
        for line in self.text.splitlines():
            tw.line(line)


class GoldenFile(pytest.File):
    """One golden spec."""

    @classmethod
    def of(cls, parent: pytest.Collector, *, path: Path, load: Load, run: Run) -> GoldenFile:
        """The collector of the spec at ``path``; ``load`` reads it, ``run`` runs its items."""
        file: GoldenFile = cls.from_parent(parent, path=path)
        file.load = load
        file.run = run
        return file

    load: Load
    run: Run

    def collect(self) -> list[pytest.Item]:
        """One item per realization.

        Raises:
            CollectError: the spec or its twin is broken, in one line.
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
    travels: str | None = None
    """The outcome as JSON, once it ran."""

    @classmethod
    def of(cls, parent: GoldenFile, *, gate: Gate, golden: Golden, realization: str) -> GoldenItem:
        """The item of ``golden`` on ``realization``."""
        name = f"{parent.path.stem}[{realization}]"
        # Stated, so that the brackets are read as those of a parametrized test; --lf finds it.
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
        """Run it; raises what it has to say."""
        self.run(self)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """The spec, and the line of its first field (0-based)."""
        return self.path, self.golden.lines.get("kind", 1) - 1, self.name

    def repr_failure(  # type: ignore[override]
        self, excinfo: pytest.ExceptionInfo[BaseException]
    ) -> Any:
        """Our own text for a golden that did not pass."""
        error = excinfo.value
        if isinstance(error, GoldenFailedError):
            return FailureText(error.text, error.headline, str(self.path), error.line)
        return super().repr_failure(excinfo)
