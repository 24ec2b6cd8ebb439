"""Limit of the processor time of one run of a command, and its early end by its parent.

The loops of an estimation ask :func:`is_over`, and return their best result so far.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

from pytest_twin.interrupts import is_stop_requested
from pytest_twin.processor_time import call_began, processor_seconds


class TimeLimit:
    """Processor time that one run may use, children included.

    Args:
        seconds: limit, s; 0 for none.
        clock: function that returns the processor time so far, s.
        begin: reading of the clock from which the limit counts; the present one by default.

    Attributes:
        clock: function that returns the processor time so far, s.
        begin: its reading from which the limit counts.
        not_tried: work that was not begun, or not finished, because the run had to end.
    """

    def __init__(
        self,
        seconds: float = 0.0,
        clock: Callable[[], float] = processor_seconds,
        begin: float | None = None,
    ) -> None:
        self.seconds = seconds
        self.clock = clock
        self.begin = clock() if begin is None else begin
        self._ended = ""
        self._is_stopped = False
        self.not_tried: list[str] = []

    def is_over(self) -> bool:
        """Whether the run must end; remembered for :attr:`reason`."""
        if self._ended:
            return True
        if is_stop_requested():
            self._ended, self._is_stopped = "it was stopped", True
        elif self.seconds and self.clock() - self.begin > self.seconds:
            self._ended = f"its {self.seconds:g} processor seconds were over"
        return bool(self._ended)

    def skips(self, what: str) -> bool:
        """Whether the run must end, so that a piece of work is not begun; it is noted then.

        Args:
            what: name of the work, for the reader.
        """
        if self.is_over() and what not in self.not_tried:
            self.not_tried.append(what)
        return bool(self._ended)

    def left_out(self, works: Sequence[str]) -> None:
        """Note work that a part of the run left out, because its own share of the time was over.

        Args:
            works: names of the work, for the reader.
        """
        if works and not self.is_over():
            self._ended = f"its {self.seconds:g} processor seconds were over"
        self.not_tried += [what for what in works if what not in self.not_tried]

    def note(self, otherwise: str = "") -> str:
        """Why the run ended early, what it did not try, and what to do; empty if it did not.

        Args:
            otherwise: what the result is therefore.
        """
        if not self._ended:
            return ""
        left = f" Not tried: {'; '.join(self.not_tried)}." if self.not_tried else ""
        so = f" {otherwise}." if otherwise else ""
        more = "" if self._is_stopped else " with a larger --seconds (0: no limit)"
        return (
            f"the command ended early, because {self._ended}.{left}{so} Run it again{more} for a "
            "complete result"
        )

    @property
    def reason(self) -> str:
        """Why the run ended early; empty if it did not."""
        return self._ended


_NO_LIMIT = TimeLimit()
_LIMIT: ContextVar[TimeLimit] = ContextVar("LIMIT", default=_NO_LIMIT)


def current_limit() -> TimeLimit:
    """Return the limit of the present run."""
    return _LIMIT.get()


def is_over() -> bool:
    """Whether the present run must end."""
    return current_limit().is_over()


def skips(what: str) -> bool:
    """Whether the present run must end, so that a piece of work is not begun; it is noted then."""
    return current_limit().skips(what)


@contextmanager
def limited(seconds: float) -> Iterator[TimeLimit]:
    """Context of a run with a limit.

    Args:
        seconds: limit of the processor time, s; 0 for none. In a child process it counts from the
            start of the call, imports included.
    """
    limit = TimeLimit(seconds, processor_seconds, call_began())
    token = _LIMIT.set(limit)
    try:
        yield limit
    finally:
        _LIMIT.reset(token)
