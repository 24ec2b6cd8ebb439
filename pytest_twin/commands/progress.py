"""Show the progress of long work: a live line on a terminal, a line each minute in a log."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Self

from pytest_twin.commands.terminal import write_line
from pytest_twin.interrupts import StopRequest, stop_on_interrupt
from pytest_twin.report.progress_log import ProgressLog
from pytest_twin.report.text import printable

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

_LOOK_SECONDS = 1.0
"""Time between two updates."""


class Progress:
    """Shows stage, fraction done and time left on standard error while it is entered.

    Args:
        work: description of the work, such as ``diagnosing``.
        stages: fraction at which each stage begins, ascending, and the stage's name.
    """

    def __init__(self, work: str, stages: Sequence[tuple[float, str]] = ()) -> None:
        self.work = work
        self._stages = stages
        self._log = ProgressLog(work)
        self._live: RichProgress | None = None
        self._done = 0.0
        self._state = ""
        self._ended = threading.Event()

    def __enter__(self) -> Self:
        # rich takes time to load, so only a terminal uses it.
        if sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
            self._live = _live_line()
            self._live.start()
            self._live.add_task(self.work, total=1.0)
        else:
            threading.Thread(target=self._each_minute, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        if self._live is not None:
            self._live.stop()
            self._live = None

    def begin(self, work: str) -> None:
        """Start the next piece of work, with fraction 0."""
        self.work = work
        self._done = 0.0
        self._state = ""
        self._log = ProgressLog(work)
        if self._live is not None:
            self._live.reset(self._live.task_ids[0], description=work, total=1.0)

    def __call__(self, fraction: float) -> None:
        """Show that ``fraction``, 0 to 1, is done."""
        self._done = fraction
        if self._live is not None:
            stage = self._stage()
            text = f"{self.work}: {stage}" if stage else self.work
            self._live.update(self._live.task_ids[0], completed=fraction, description=text)

    def tell(self, kind: str, text: str) -> None:
        """Show a message of the work.

        Args:
            kind: ``line`` for a separate line, ``state`` for text shown with the stage until the
                next stage.
            text: the message, without line breaks.
        """
        if kind == "state":
            self._state = printable(text)
            self(self._done)
        elif self._live is not None:
            self._live.console.print(printable(text), markup=False, highlight=False)
        else:
            write_line(printable(text), sys.stderr)

    def stopping_early(self, written: str) -> AbstractContextManager[StopRequest]:
        """Context in which the first interrupt ends the work of child processes early.

        Args:
            written: what is written then.
        """
        return stop_on_interrupt(
            lambda: self.tell("line", f"stopping: {written}; Ctrl-C again aborts")
        )

    def _stage(self) -> str:
        stage = next((name for start, name in reversed(self._stages) if self._done >= start), "")
        return "; ".join(part for part in (stage, self._state) if part)

    def _each_minute(self) -> None:
        # A step of the work may take many minutes without a report.
        while not self._ended.wait(_LOOK_SECONDS):
            if (line := self._log.line(self._done, self._stage())) is not None:
                write_line(line, sys.stderr)


def _live_line() -> RichProgress:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        SpinnerColumn,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
