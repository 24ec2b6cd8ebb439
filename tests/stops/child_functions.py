"""Functions that the tests call in child processes."""

from __future__ import annotations

import os
import time

from pytest_twin import interrupts
from pytest_twin.realization.forks import in_forks


def asks_to_stop(seconds: float) -> str:
    """Answer of a child process: whether it was asked to stop within a time, by polling."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if interrupts.is_stop_requested():
            return "stopped"
        time.sleep(0.01)
    return "not stopped"


def signal_all(number: int) -> str:
    """Send a signal to this child process and to a fork of it; both ignore it."""
    parent = os.getpid()

    def task() -> int:
        os.kill(os.getpid(), number)
        time.sleep(0.05)
        return os.getpid()

    alive = in_forks([task] * 4, 2)
    return "alive" if parent in alive and len(set(alive)) > 1 else f"only {alive}"
