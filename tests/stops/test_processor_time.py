"""Processor time counts this process and its children, and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from pytest_twin.estimation.deadline import OutOfTime, check_deadline, ending_at_limit
from pytest_twin.processor_time import processor_seconds, unwatch, watch
from pytest_twin.realization.forks import in_forks
from pytest_twin.time_limit import TimeLimit, current_limit, limited, skips

forks = pytest.mark.skipif(sys.platform != "linux", reason="forks are used on Linux only")


class Clock:
    """Processor time that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def compute(seconds: float) -> float:
    """Use processor time in this process, and return what it uses."""
    start = time.process_time()
    while time.process_time() - start < seconds:
        pass
    return time.process_time() - start


def test_waiting_uses_no_processor_time() -> None:
    start = processor_seconds()
    time.sleep(0.3)
    assert processor_seconds() - start < 0.1


def test_other_programs_do_not_lengthen_processor_time() -> None:
    loop = [sys.executable, "-c", "while True: pass"]
    others = [subprocess.Popen(loop) for _ in range(3 * (os.cpu_count() or 1))]
    try:
        start, began = processor_seconds(), time.monotonic()
        compute(0.4)
        used, waited = processor_seconds() - start, time.monotonic() - began
    finally:
        for other in others:
            other.kill()
        for other in others:
            other.wait()
    assert used < 0.6
    assert waited > used, "the other programs had their share of the processors"


@forks
def test_running_children_count_before_they_end() -> None:
    start = processor_seconds()
    child = os.fork()
    if child == 0:
        compute(0.3)
        signal.pause()
    watch(child)
    try:
        end = time.monotonic() + 60.0
        while processor_seconds() - start < 0.3 and time.monotonic() < end:
            time.sleep(0.02)
        seen = processor_seconds() - start
        assert os.waitpid(child, os.WNOHANG) == (0, 0), "the child still runs"
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        unwatch(child)
    assert seen >= 0.3
    assert processor_seconds() - start >= seen - 0.02


@forks
def test_the_clock_of_a_fork_continues_that_of_its_parent() -> None:
    start = processor_seconds()
    assert min(in_forks([partial(_elapsed, start)] * 4, 2)) >= 0.0


def _elapsed(start: float) -> float:
    time.sleep(0.02)
    return processor_seconds() - start


@forks
def test_time_of_ended_children_stays() -> None:
    start = processor_seconds()
    in_forks([partial(compute, 0.2)] * 4, 2)
    after = processor_seconds() - start
    assert after >= 0.75
    time.sleep(0.1)
    in_forks([partial(compute, 0.0)] * 2, 2)
    assert processor_seconds() - start >= after


def test_a_limit_counts_from_its_beginning_and_says_why_a_run_ended() -> None:
    clock = Clock()
    limit = TimeLimit(5.0, clock)
    clock.now += 5.0
    assert not limit.skips("friction")
    assert limit.note() == ""
    clock.now += 0.1
    assert limit.skips("drive")
    clock.now -= 1.0
    assert limit.is_over(), "an end stays an end"
    assert limit.not_tried == ["drive"]
    assert limit.note().startswith(
        "the command ended early, because its 5 processor seconds were over. Not tried: drive."
    )


def test_a_limit_of_zero_is_none() -> None:
    clock = Clock()
    limit = TimeLimit(0.0, clock)
    clock.now += 1e9
    assert not limit.is_over()


def test_a_simulation_is_interrupted_only_within_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    with limited(1e-9), ending_at_limit():
        compute(0.02)
        with pytest.raises(OutOfTime):
            check_deadline()
        assert skips("the rest")
        assert current_limit().not_tried == ["the rest"]
    check_deadline()
    assert not skips("the rest")
