"""Run independent tasks on several cores, in forks of this process.

The laws between simulation steps are Python code, which one interpreter runs on one core. A fork
shares the memory of its parent, so that no input is sent; results return through a pipe.
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

from pytest_twin import processor_time
from pytest_twin.interrupts import deferred_interrupts, leave_interrupts_to_parent

_Result = TypeVar("_Result")
# A fork costs its parent about 10 ms, so that more processes do not shorten the run.
_MAX_PROCESSES = 8
# Bytes of a task number, and largest number of tasks. A pipe holds all numbers at once; its
# smallest capacity is one page (4096 bytes).
_NUMBER_BYTES, _MAX_TASKS = 4, 1024

_in_task = False
_ended: set[int] = set()


def in_forks(tasks: Sequence[Callable[[], _Result]], processes: int) -> list[_Result]:
    """Run tasks in forks and in this process; the results are in the order of the tasks.

    Each process that becomes free takes the next task. Within a task, and where the system cannot
    fork safely, all tasks run in this process.

    Args:
        tasks: independent tasks, the longest first. A result must be picklable; other changes that
            a task makes are lost if it runs in a fork.
        processes: largest number of processes, including this one.

    Raises:
        Exception: an exception of a task. A task that fails in a fork, or whose fork dies, is run
            again in this process; finished results of the fork are kept.
    """
    global _in_task
    _reap_ended()
    helpers = min(free_cores(processes), len(tasks)) - 1
    if helpers < 1 or len(tasks) > _MAX_TASKS:
        return [task() for task in tasks]
    numbers, writer = os.pipe()
    os.write(writer, b"".join(i.to_bytes(_NUMBER_BYTES, "little") for i in range(len(tasks))))
    os.close(writer)
    forks: list[_Fork[_Result]] = []
    _in_task = True
    try:
        # The system may allow fewer processes than requested.
        with contextlib.suppress(OSError):
            for _ in range(helpers):
                forks.append(_Fork(tasks, numbers))
        found = _run_untaken_tasks(tasks, numbers)
        for fork in forks:
            found |= fork.found()
    finally:
        _in_task = False
        os.close(numbers)
        for fork in forks:
            fork.end()
        _reap_ended()
    return [found[i] if i in found else task() for i, task in enumerate(tasks)]


def usable_cores() -> int:
    """Number of CPU cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return (os.cpu_count() or 1) if allowed is None else len(allowed(0))


def free_cores(count: int) -> int:
    """Number of processes that may run tasks, at most ``count``.

    It is one within a task, because the other tasks use the other cores, and on systems without a
    safe fork.
    """
    # Libraries of macOS fail after a fork, and Windows has no fork.
    alone = _in_task or sys.platform != "linux"
    return 1 if alone else min(count, _MAX_PROCESSES)


def threads_here(count: int) -> int:
    """Number of threads of a batch: ``count``, or one within a task."""
    return 1 if _in_task else count


def _run_untaken_tasks(tasks: Sequence[Callable[[], _Result]], numbers: int) -> dict[int, _Result]:
    """Run tasks that no other process has taken, until none remains; task number -> result."""
    found = {}
    while number := os.read(numbers, _NUMBER_BYTES):
        i = int.from_bytes(number, "little")
        found[i] = tasks[i]()
    return found


class _Fork(Generic[_Result]):
    """A forked process that runs tasks and ends."""

    def __init__(self, tasks: Sequence[Callable[[], _Result]], numbers: int) -> None:
        read, write = os.pipe()
        self.answers: BinaryIO = os.fdopen(read, "rb")
        try:
            with deferred_interrupts():
                self.process = os.fork()
                if self.process == 0:
                    leave_interrupts_to_parent()
                    _run_in_fork(tasks, numbers, write)
            processor_time.watch(self.process)
        except OSError:
            self.answers.close()
            raise
        finally:
            os.close(write)

    def found(self) -> dict[int, _Result]:
        """Task number -> result; from a fork that failed, the results that it finished."""
        found: dict[int, _Result] = {}
        # The data come from a fork of this process only, so that pickle is safe.
        with contextlib.suppress(EOFError, pickle.UnpicklingError, MemoryError):
            while True:
                number, result = pickle.load(self.answers)  # noqa: S301
                found[number] = result
        return found

    def end(self) -> None:
        """Kill the process without waiting until its memory is released."""
        self.answers.close()
        # Other code in this process may have reaped all child processes.
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process, signal.SIGKILL)
        _ended.add(self.process)


def _reap_ended() -> None:
    """Reap the forked processes that have ended."""
    for process in tuple(_ended):
        with contextlib.suppress(ChildProcessError):
            if not os.waitpid(process, os.WNOHANG)[0]:
                continue
        processor_time.unwatch(process)
        _ended.discard(process)


def _run_in_fork(tasks: Sequence[Callable[[], object]], numbers: int, answers: int) -> None:
    """Run tasks in a fork and write the results to the pipe ``answers``; does not return.

    Each result is written at once, as far as the pipe has room. A fork that dies then loses only
    its last task, and no fork waits for its parent.
    """
    parent = os.getppid()
    # The garbage collector must not finalize objects of the parent, such as its threads.
    gc.freeze()
    try:
        backlog = bytearray()
        os.set_blocking(answers, False)
        # Signals that ended the parent do not end this process.
        while os.getppid() == parent and (number := os.read(numbers, _NUMBER_BYTES)):
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
