"""Interrupts: Ctrl-C (SIGINT), and SIGTERM, which schedulers, CI and containers send.

Terminals, CI and schedulers send a signal to every process of a job. Children therefore ignore
both, and the process that the user started passes a :class:`StopRequest` on to them.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Self

_Handler = Callable[[int, FrameType | None], object]
_SIGNALS = {signal.SIGINT, signal.SIGTERM}
_SAME_SECONDS = 1.0
"""Time within which a second signal is the same interrupt, s: GNU ``timeout`` sends its signal to
the program and to its process group."""


class StopRequest:
    """A request to end early, from a process to its children and to their forks.

    It is one byte in a pipe that nobody reads, so that every process that has the pipe sees it.
    """

    def __init__(self) -> None:
        self.descriptor, self._write = os.pipe()
        self._is_sent = False

    def send(self) -> None:
        """Ask the children to end early."""
        if not self._is_sent:
            self._is_sent = True
            os.write(self._write, b"\0")

    @property
    def is_sent(self) -> bool:
        """Whether this process or its parent has sent it."""
        return self._is_sent or _is_readable(self.descriptor)

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        # Its pipe exists on this machine only; elsewhere there is no request.
        return _no_request, ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        os.close(self.descriptor)
        os.close(self._write)


def _no_request() -> None:
    return None


_received: int | None = None
"""Pipe of the parent's stop request; None in the process that the user started."""


def receive_stop(descriptor: int) -> None:
    """Take stop requests of the parent from a pipe, in this process and its forks.

    Args:
        descriptor: :attr:`StopRequest.descriptor`.
    """
    global _received
    _received = descriptor


def is_stop_requested() -> bool:
    """Whether the parent of this child process asks it to end early, or has ended."""
    return _received is not None and _is_readable(_received)


@contextlib.contextmanager
def stop_on_interrupt(tell: Callable[[], None] = lambda: None) -> Iterator[StopRequest]:
    """Context in which the first interrupt sends a stop request, and a later Ctrl-C aborts.

    A later SIGTERM is ignored: a build machine that sends it after SIGINT waits for the result
    that is being written.

    Args:
        tell: called after the first interrupt.
    """
    with StopRequest() as request:
        if not _is_main_thread():
            yield request
            return
        before = signal.getsignal(signal.SIGINT)
        sent_at: float | None = None

        def stop(number: int, frame: FrameType | None) -> None:
            nonlocal sent_at
            if sent_at is None:
                sent_at = time.monotonic()
                request.send()
                # The interrupted code may be writing to the same stream.
                with contextlib.suppress(RuntimeError):
                    tell()
            elif number == signal.SIGINT and time.monotonic() - sent_at > _SAME_SECONDS:
                (before if callable(before) else signal.default_int_handler)(number, frame)

        # SIGTERM reaches this handler by :func:`sigterm_as_interrupt`.
        with _handler(signal.SIGINT, stop):
            yield request


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
def deferred_interrupts() -> Iterator[None]:
    """Context that starts a child: both signals wait, here until its end and in the child until
    :func:`leave_interrupts_to_parent`.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave_interrupts_to_parent() -> None:
    """Ignore both signals in a child process, those that have waited included."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)


@contextlib.contextmanager
def _handler(number: signal.Signals, handler: _Handler) -> Iterator[None]:
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


def _is_readable(descriptor: int) -> bool:
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(0))


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
