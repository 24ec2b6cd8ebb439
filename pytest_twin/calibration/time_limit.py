"""Limit of the processor time of a calibration, and its end by an interrupt.

The loops of the solvers ask :func:`is_over` and return their best values. What was not done then
is in the result, which is never accepted.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from pytest_twin.processor_time import processor_seconds


class TimeLimit:
    """Processor time that one calibration may use from now on.

    Args:
        seconds: limit, s; 0 for none.
    """

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds
        self._start = processor_seconds()
        self._stopped = False
        self._ended = ""

    def stop(self) -> None:
        """End the calibration at the next check, as if its time were over."""
        self._stopped = True

    def is_over(self) -> bool:
        """Whether the calibration must end; remembered for :attr:`reason`."""
        if self._stopped:
            self._ended = "it was interrupted"
        elif self.seconds and processor_seconds() - self._start > self.seconds:
            self._ended = f"the limit of {self.seconds:g} s of processor time was reached"
        return bool(self._ended)

    @property
    def reason(self) -> str:
        """Why the calibration ended early; empty if it did not."""
        if not self._ended:
            return ""
        return (
            f"{self._ended}: these are the best values so far, and not all checks were made; "
            "run it again with a larger --seconds (0: without limit)"
        )


_LIMIT: ContextVar[TimeLimit | None] = ContextVar("LIMIT", default=None)


def current_limit() -> TimeLimit:
    """Return the limit of the running calibration."""
    return _LIMIT.get() or TimeLimit()


def is_over() -> bool:
    """Whether the running calibration must end."""
    return current_limit().is_over()


@contextmanager
def limited(limit: TimeLimit) -> Iterator[None]:
    """Context of a calibration with a limit."""
    token = _LIMIT.set(limit)
    try:
        yield
    finally:
        _LIMIT.reset(token)
