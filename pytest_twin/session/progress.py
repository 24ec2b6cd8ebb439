"""Progress of a golden: a line that is updated on a terminal, one line per minute in a log."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import pytest

from pytest_twin.report.progress_log import ProgressLog

_FIRST_SECONDS = 1.0
"""Time before the first update; short goldens show none."""
_EACH_SECONDS = 0.25
"""Time between two updates."""


class ProgressLine:
    """Writes the progress through pytest's terminal reporter."""

    def __init__(self, config: pytest.Config) -> None:
        self._reporter: Any = config.pluginmanager.get_plugin("terminalreporter")
        self._capture: Any = config.pluginmanager.get_plugin("capturemanager")

    def say(self, text: str) -> None:
        """Write a separate line, on a terminal or in a log."""
        if self._reporter is not None:
            self._reporter.ensure_newline()
            self._reporter.write_line(text)

    def of(self, item: pytest.Item) -> AbstractContextManager[Callable[[float], None] | None]:
        """Callback for the progress of an item (0 to 1); None in a process without output."""
        return self.named(item.name)

    @contextmanager
    def named(self, name: str) -> Iterator[Callable[[float], None] | None]:
        """Callback for the progress of ``name`` (0 to 1); None in a process without output."""
        if self._reporter is None:
            yield None
            return
        if not getattr(self._reporter, "isatty", False):
            log = ProgressLog(name)

            def write_fraction(fraction: float) -> None:
                if (line := log.line(fraction)) is not None:
                    with self._uncaptured():
                        self.say(line)

            yield write_fraction
            return
        next_time = time.monotonic() + _FIRST_SECONDS
        shown = False

        def progress(fraction: float) -> None:
            nonlocal next_time, shown
            now = time.monotonic()
            if now >= next_time:
                next_time = now + _EACH_SECONDS
                self._write(f"{name} {100.0 * fraction:3.0f} %", first=not shown)
                shown = True

        yield progress
        if shown:
            self._write("", first=False)

    def _write(self, text: str, *, first: bool) -> None:
        with self._uncaptured():
            self._rewrite(text, first=first)

    def _uncaptured(self) -> AbstractContextManager[None]:
        if self._capture is None:
            return nullcontext()
        uncaptured: AbstractContextManager[None] = self._capture.global_and_fixture_disabled()
        return uncaptured

    def _rewrite(self, text: str, *, first: bool) -> None:
        if first:
            self._reporter.ensure_newline()
        self._reporter.rewrite(text, erase=True)
        self._reporter.flush()
