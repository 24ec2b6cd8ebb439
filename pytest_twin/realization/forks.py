"""Independent work on several cores, in forks of this process.

What acts between steps is Python, and one interpreter runs that on one core. A fork has all that
its parent has in memory, nothing is sent to it, and what it found comes back through a pipe.
"""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import signal
import sys
from collections.abc import Callable, Sequence
from typing import BinaryIO, Generic, TypeVar

_Result = TypeVar("_Result")
# Each fork takes its parent some 10 ms: more of them are not sooner done.
_MOST_PROCESSES = 8
# Numbers of tasks are taken off a pipe that holds them all at once: the least is one page.
_NUMBER, _MOST_TASKS = 4, 1024

_sharing = False
_ended: set[int] = set()


def in_forks(tasks: Sequence[Callable[[], _Result]], processes: int) -> list[_Result]:
    """Results of tasks in their order. Whoever is done takes the next, forks and this process.

    Where the system cannot fork safely, and within a task, all are done here.

    Args:
        tasks: independent of one another, the longest first. What one leaves behind beside its
            result, which must be such as can be pickled, is lost where a fork does it.
        processes: at most, this one among them.

    Raises:
        Exception: what a task raises. One that fails in a fork, or dies with it, is done again
            here; what that fork finished before stands.
    """
    global _sharing
    helpers = min(free_cores(processes), len(tasks)) - 1
    if helpers < 1 or len(tasks) > _MOST_TASKS:
        return [task() for task in tasks]
    _bury()
    numbers, filled = os.pipe()
    os.write(filled, b"".join(i.to_bytes(_NUMBER, "little") for i in range(len(tasks))))
    os.close(filled)
    forks: list[_Fork[_Result]] = []
    _sharing = True
    try:
        # Fewer than asked for, where the system gives no more.
        with contextlib.suppress(OSError):
            for _ in range(helpers):
                forks.append(_Fork(tasks, numbers))
        found = _taken(tasks, numbers)
        for fork in forks:
            found |= fork.found()
    finally:
        _sharing = False
        os.close(numbers)
        for fork in forks:
            fork.end()
        _bury()
    return [found[i] if i in found else task() for i, task in enumerate(tasks)]


def usable_cores() -> int:
    """Cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return (os.cpu_count() or 1) if allowed is None else len(allowed(0))


def free_cores(count: int) -> int:
    """Of ``count`` cores, those that forks of this process may take part with: one within a task,
    whose neighbours have the others, and where a process cannot fork safely.
    """
    # Apple's libraries do not survive a fork, and Windows has none.
    alone = _sharing or sys.platform != "linux"
    return 1 if alone else min(count, _MOST_PROCESSES)


def threads_here(count: int) -> int:
    """Of ``count`` threads, those that a batch is to have: one within a task."""
    return 1 if _sharing else count


def _taken(tasks: Sequence[Callable[[], _Result]], numbers: int) -> dict[int, _Result]:
    """Do tasks that no other process has taken, until none remains."""
    found = {}
    while number := os.read(numbers, _NUMBER):
        i = int.from_bytes(number, "little")
        found[i] = tasks[i]()
    return found


class _Fork(Generic[_Result]):
    """A copy of this process that takes tasks, and ends."""

    def __init__(self, tasks: Sequence[Callable[[], _Result]], numbers: int) -> None:
        read, write = os.pipe()
        self.answers: BinaryIO = os.fdopen(read, "rb")
        try:
            self.process = os.fork()
            if self.process == 0:
                _work(tasks, numbers, write)
        except OSError:
            self.answers.close()
            raise
        finally:
            os.close(write)

    def found(self) -> dict[int, _Result]:
        """Number of a task -> its result; of a fork that failed, what it had finished."""
        found: dict[int, _Result] = {}
        # Written by a copy of this process alone.
        with contextlib.suppress(EOFError, pickle.UnpicklingError, MemoryError):
            while True:
                number, result = pickle.load(self.answers)  # noqa: S301
                found[number] = result
        return found

    def end(self) -> None:
        """End the process, finished or not, without waiting for its memory to be released."""
        self.answers.close()
        # Somebody else in this process may have waited for all its children.
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process, signal.SIGKILL)
        _ended.add(self.process)


def _bury() -> None:
    """Reap forked processes that have ended."""
    for process in tuple(_ended):
        with contextlib.suppress(ChildProcessError):
            if not os.waitpid(process, os.WNOHANG)[0]:
                continue
        _ended.discard(process)


def _work(tasks: Sequence[Callable[[], object]], numbers: int, answers: int) -> None:
    """All that a fork does.

    A result is written when it is there, as far as the pipe has room, so that a fork that dies
    takes its last task with it alone and no fork waits for its parent.
    """
    # What the parent's garbage holds (threads that this process does not have) is not its to end.
    gc.freeze()
    try:
        backlog = bytearray()
        os.set_blocking(answers, False)
        while number := os.read(numbers, _NUMBER):
            i = int.from_bytes(number, "little")
            backlog += pickle.dumps((i, tasks[i]()), protocol=pickle.HIGHEST_PROTOCOL)
            with contextlib.suppress(BlockingIOError):
                while backlog:
                    del backlog[: os.write(answers, backlog)]
        os.set_blocking(answers, True)
        while backlog:
            del backlog[: os.write(answers, backlog)]
    finally:
        os._exit(0)
