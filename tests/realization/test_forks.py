"""Work that is shared with forks of the process."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pytest_twin.realization import forks as forks_of_the_process
from pytest_twin.realization.forks import free_cores, in_forks, threads_here, usable_cores

forks = pytest.mark.skipif(sys.platform != "linux", reason="forks are shared with on Linux alone")


def _open_files() -> set[Path]:
    return set(Path("/proc/self/fd").iterdir())


def _squared(x: int) -> tuple[int, int]:
    time.sleep(0.02)
    return x * x, os.getpid()


@forks
def test_results_come_in_order_from_more_than_one_process() -> None:
    found = in_forks([partial(_squared, i) for i in range(12)], 3)
    assert [square for square, _ in found] == [i * i for i in range(12)]
    assert len({process for _, process in found}) == 3


def test_one_process_does_all_itself() -> None:
    found = in_forks([partial(_squared, i) for i in range(3)], 1)
    assert {process for _, process in found} == {os.getpid()}


@forks
def test_arrays_come_back_whole() -> None:
    def made(seed: int) -> np.ndarray:
        return np.random.default_rng(seed).normal(size=(300_000, 3))

    for i, array in enumerate(in_forks([partial(made, i) for i in range(4)], 2)):
        assert np.array_equal(array, made(i))


@forks
def test_tasks_of_tasks_are_not_shared_again() -> None:
    def outer() -> tuple[int, int, set[int]]:
        inner = in_forks([partial(_squared, i) for i in range(4)], 4)
        return free_cores(4), threads_here(4), {process for _, process in inner}

    for cores, threads, processes in in_forks([outer, outer], 2):
        assert (cores, threads, len(processes)) == (1, 1, 1)
    assert (free_cores(4), threads_here(4)) == (4, 4)


@forks
def test_what_fails_in_a_fork_is_done_again_here_and_raises_here() -> None:
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


@forks
def test_no_fork_and_no_pipe_is_left_behind() -> None:
    before = _open_files()

    def interrupted() -> None:
        raise KeyboardInterrupt

    for tasks in ([partial(_squared, i) for i in range(4)], [interrupted] * 2):
        with contextlib.suppress(KeyboardInterrupt):
            in_forks(tasks, 2)
        time.sleep(0.2)
        in_forks([partial(_squared, i) for i in range(2)], 2)
        time.sleep(0.2)
        forks_of_the_process._bury()
        with pytest.raises(ChildProcessError):
            os.waitpid(-1, os.WNOHANG)
    gc.collect()
    assert _open_files() == before


@forks
def test_where_the_system_gives_no_fork_all_is_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> int:
        raise BlockingIOError

    monkeypatch.setattr(os, "fork", none)
    before = _open_files()
    found = in_forks([partial(_squared, i) for i in range(4)], 2)
    assert found == [(i * i, os.getpid()) for i in range(4)]
    gc.collect()
    assert _open_files() == before


def test_cores_are_those_that_the_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 5, 6}, raising=False)
    assert usable_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert usable_cores() == os.cpu_count()
