"""Interruption of a search that runs out of time, at its next simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from pytest_twin.time_limit import is_over


class OutOfTime(Exception):  # noqa: N818 - no error: the best so far is the result
    """The search must end; the best result so far is used."""


def no_limit() -> None:
    """Check of a search without a time limit: do nothing."""


CHECK: ContextVar[Callable[[], None]] = ContextVar("CHECK", default=no_limit)
"""Function that is called before every simulation; raises :class:`OutOfTime` after the deadline."""


@contextmanager
def ending_at_limit() -> Iterator[None]:
    """Context in which a simulation raises :class:`OutOfTime` when the present run must end."""
    token = CHECK.set(_check_limit)
    try:
        yield
    finally:
        CHECK.reset(token)


def _check_limit() -> None:
    if is_over():
        raise OutOfTime


def check_deadline() -> None:
    """Check the deadline of the running search.

    Raises:
        OutOfTime: the time of the search is over.
    """
    CHECK.get()()
