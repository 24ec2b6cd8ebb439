"""Interrupts: Ctrl-C (SIGINT), and SIGTERM, which schedulers, CI and containers send."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

_Handler = Callable[[int, FrameType | None], object]


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Context in which SIGTERM does what Ctrl-C does; a handler of another program stays."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        handler = signal.getsignal(signal.SIGINT)
        # A shell starts background jobs with SIGINT ignored; SIGTERM still has to end them.
        (handler if callable(handler) else signal.default_int_handler)(number, frame)

    free = _is_main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    with _handler(signal.SIGTERM, interrupt) if free else contextlib.nullcontext():
        yield


@contextlib.contextmanager
def first_interrupt(stop: Callable[[], None]) -> Iterator[None]:
    """Context in which the first interrupt calls ``stop``, and the second one aborts."""
    if not _is_main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGINT)

    def stop_once(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, before)
        stop()

    with _handler(signal.SIGINT, stop_once):
        yield


@contextlib.contextmanager
def stopped_by_parent(stop: Callable[[], None]) -> Iterator[None]:
    """Context in a child process in which an interrupt that its parent forwards calls ``stop``.

    The child was started with SIGINT blocked, so that an earlier interrupt arrives here too.
    """
    if not _is_main_thread():
        yield
        return
    with _handler(signal.SIGINT, lambda number, frame: stop()):
        blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def defer_in_child() -> None:
    """Leave the end of a child process to its parent, also if a signal reaches all processes."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


@contextlib.contextmanager
def _handler(number: signal.Signals, handler: _Handler) -> Iterator[None]:
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
