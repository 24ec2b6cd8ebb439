"""Distribution of work among forked processes."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import time
import traceback
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pytest_twin.realization.forks import free_cores, in_forks, threads_here, usable_cores

forks = pytest.mark.skipif(sys.platform != "linux", reason="forks are used on Linux only")


def _open_files() -> set[Path]:
    return set(Path("/proc/self/fd").iterdir())


def _squared(x: int) -> tuple[int, int]:
    time.sleep(0.02)
    return x * x, os.getpid()


@forks
def test_forked_results_are_in_order_and_from_several_processes() -> None:
    found = in_forks([partial(_squared, i) for i in range(12)], 3)
    assert [square for square, _ in found] == [i * i for i in range(12)]
    assert len({process for _, process in found}) == 3


def test_with_one_process_no_fork_is_made() -> None:
    found = in_forks([partial(_squared, i) for i in range(3)], 1)
    assert {process for _, process in found} == {os.getpid()}


@forks
def test_large_arrays_are_returned_unchanged() -> None:
    def random_array(seed: int) -> np.ndarray:
        return np.random.default_rng(seed).normal(size=(300_000, 3))

    for i, array in enumerate(in_forks([partial(random_array, i) for i in range(4)], 2)):
        assert np.array_equal(array, random_array(i))


@forks
def test_tasks_inside_a_fork_are_not_forked_again() -> None:
    def outer() -> tuple[int, int, set[int]]:
        inner = in_forks([partial(_squared, i) for i in range(4)], 4)
        return free_cores(4), threads_here(4), {process for _, process in inner}

    for cores, threads, processes in in_forks([outer, outer], 2):
        assert (cores, threads, len(processes)) == (1, 1, 1)
    assert (free_cores(4), threads_here(4)) == (4, 4)


@forks
def test_a_task_that_fails_in_a_fork_is_repeated_in_the_parent() -> None:
    here = os.getpid()

    def dies() -> int:
        if os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.05)
        return 7

    assert in_forks([dies] * 4, 2) == [7] * 4

    def raises() -> int:
        time.sleep(0.02)
        raise ValueError("seven")

    with pytest.raises(ValueError, match="seven"):
        in_forks([raises] * 4, 2)
    assert free_cores(4) == 4


def _leaves_no_process_and_no_pipe() -> None:
    before = _open_files()

    def interrupted() -> None:
        raise KeyboardInterrupt

    for tasks in ([partial(_squared, i) for i in range(4)], [interrupted] * 2):
        with contextlib.suppress(KeyboardInterrupt):
            in_forks(tasks, 2)
        time.sleep(0.2)
        in_forks([partial(_squared, i) for i in range(2)], 2)
        time.sleep(0.2)
        in_forks([], 2)
        with pytest.raises(ChildProcessError):
            os.waitpid(-1, os.WNOHANG)
    gc.collect()
    assert _open_files() == before


@forks
def test_no_process_and_no_pipe_remains() -> None:
    """In a fork, which has no children of other tests."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            _leaves_no_process_and_no_pipe()
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@forks
def test_if_fork_fails_all_tasks_run_in_the_parent(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> int:
        raise BlockingIOError

    monkeypatch.setattr(os, "fork", none)
    before = _open_files()
    found = in_forks([partial(_squared, i) for i in range(4)], 2)
    assert found == [(i * i, os.getpid()) for i in range(4)]
    gc.collect()
    assert _open_files() == before


def test_usable_cores_follow_the_cpu_affinity_of_the_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 5, 6}, raising=False)
    assert usable_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert usable_cores() == os.cpu_count()
