"""A search that runs out of time is interrupted at its next simulation."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar


class OutOfTime(Exception):  # noqa: N818 - no error: the best so far is the result
    """The search has to end with the best so far."""


def no_bound() -> None:
    """Never end."""


CHECK: ContextVar[Callable[[], None]] = ContextVar("CHECK", default=no_bound)
"""Called before every simulation; raises :class:`OutOfTime` where the time of a search is over."""


def check() -> None:
    """Go on, or end the search.

    Raises:
        OutOfTime: its time is over.
    """
    CHECK.get()()
