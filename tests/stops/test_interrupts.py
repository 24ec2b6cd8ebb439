"""One interrupt stops early, a later Ctrl-C aborts, and children leave both signals alone."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from pytest_twin import interrupts
from pytest_twin.interrupts import StopRequest, sigterm_as_interrupt, stop_on_interrupt
from pytest_twin.realization.forks import in_forks
from pytest_twin.realization.sandbox import Sandbox


def _send(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)


def test_the_first_interrupt_asks_to_stop_and_a_later_ctrl_c_aborts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [10.0]
    monkeypatch.setattr(interrupts.time, "monotonic", lambda: now[0])
    said: list[str] = []
    with stop_on_interrupt(partial(said.append, "stopping")) as stop:
        assert not stop.is_sent
        _send(signal.SIGINT)
        assert stop.is_sent
        # GNU timeout sends its signal to the program and to its group.
        _send(signal.SIGINT)
        now[0] += 5.0
        with pytest.raises(KeyboardInterrupt):
            _send(signal.SIGINT)
    assert said == ["stopping"]


def test_sigterm_stops_too_and_never_aborts(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [10.0]
    monkeypatch.setattr(interrupts.time, "monotonic", lambda: now[0])
    with sigterm_as_interrupt(), stop_on_interrupt() as stop:
        _send(signal.SIGTERM)
        assert stop.is_sent
        now[0] += 60.0
        _send(signal.SIGTERM)


def test_a_stop_request_reaches_forks_and_no_other_machine() -> None:
    with StopRequest() as stop:
        before = in_forks([lambda: stop.is_sent] * 4, 2)
        stop.send()
        stop.send()
        assert not any(before)
        assert all(in_forks([lambda: stop.is_sent] * 4, 2))
        assert pickle.loads(pickle.dumps(stop)) is None


@pytest.fixture(autouse=True)
def child_functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Functions for child processes, which import nothing from the working folder."""
    source = Path(__file__).with_name("child_functions.py").read_text()
    (tmp_path / "child_functions.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.skipif(sys.platform != "linux", reason="forks are used on Linux only")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_children_and_their_forks_ignore_both_signals(number: int) -> None:
    with Sandbox(seconds=60.0) as sandbox:
        assert sandbox.call("child_functions:signal_all", {"number": int(number)}) == "alive"


@pytest.mark.parametrize("first", [False, True], ids=["during the call", "before the child starts"])
def test_a_stop_request_reaches_a_child_process(first: bool) -> None:
    with StopRequest() as stop, Sandbox(seconds=60.0, stop=stop) as sandbox:
        assert sandbox.call("child_functions:asks_to_stop", {"seconds": 0.0}) == "not stopped"
        if first:
            stop.send()
            sandbox.close()
        request: Callable[[], None] = stop.send
        with _after(0.3, request):
            assert sandbox.call("child_functions:asks_to_stop", {"seconds": 30.0}) == "stopped"


class _after:  # noqa: N801 - a function of a context
    """Context that calls a function after a time, s."""

    def __init__(self, seconds: float, call: Callable[[], None]) -> None:
        self._seconds, self._call = seconds, call

    def __enter__(self) -> None:
        self._before = signal.signal(signal.SIGALRM, lambda number, frame: self._call())
        signal.setitimer(signal.ITIMER_REAL, self._seconds)

    def __exit__(self, *error: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, self._before)


def test_forks_end_with_a_parent_that_was_killed(tmp_path: Path) -> None:
    if sys.platform != "linux":
        pytest.skip("forks are used on Linux only")
    script = tmp_path / "parent.py"
    script.write_text(
        "import os, sys, time\nfrom pathlib import Path\n"
        "from pytest_twin.realization.forks import in_forks\n"
        "def task():\n"
        "    Path(sys.argv[1], str(time.monotonic_ns())).touch()\n    time.sleep(0.2)\n"
        "in_forks([task] * 200, 2)\n"
    )
    begun = tmp_path / "begun"
    begun.mkdir()
    with subprocess.Popen([sys.executable, str(script), str(begun)]) as process:
        while len(list(begun.iterdir())) < 4:
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
    time.sleep(0.5)
    count = len(list(begun.iterdir()))
    time.sleep(0.6)
    assert len(list(begun.iterdir())) == count
