"""Progress of long work: a live line on a terminal, one line per minute in a log file."""

from __future__ import annotations

import os
import pty
import subprocess
import sys

import pytest
from wheels import unpack, wheel

SLOW = """\
import time

from pytest_twin.checks import Check, Measure, Observation


class Slow(Check):
    kind = "slow"
    tolerances = {}
    schema = {}

    def depends(self, golden, structure):
        return ()

    def observe(self, golden, realization, progress):
        for step in range(1, 11):
            time.sleep(0.2)
            progress(step / 10)
        return Observation({"done": 1.0})

    def compare(self, golden, observation, stored):
        return [Measure("done", "it", 1.0, 1.0, 0.0, 1.0, "1")]
"""

# A separate pytest run, because pytest-xdist workers have no terminal. The work takes 125 s.
INNER = """
from pytest_twin.report import progress_log
from pytest_twin.session.progress import ProgressLine

def test_long(pytestconfig, monkeypatch):
    now = 0.0
    monkeypatch.setattr(progress_log.time, "monotonic", lambda: now)
    with ProgressLine(pytestconfig).named("diagnosis of arm") as progress:
        for now, fraction in ((30.0, 0.1), (61.0, 0.2), (90.0, 0.3), (125.0, 0.4)):
            progress(fraction)
    monkeypatch.undo()
"""


@pytest.fixture
def slow(recorded, monkeypatch):
    folder = recorded.pytester.path
    unpack(
        wheel(folder, "slow", "1.0", SLOW, "[pytest_twin.checks]\nslow = slow:Slow\n"),
        folder / "site",
    )
    monkeypatch.setenv("PYTHONPATH", str(folder / "site"))
    recorded.write("golden/slow.yaml", "schema: 1\nkind: slow\n")
    return recorded


def test_a_terminal_shows_the_completed_fraction(slow) -> None:
    main, end = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "pytest", "--twin-update", "-k", "slow"],
        stdin=end,
        stdout=end,
        stderr=end,
        cwd=slow.root,
    )
    os.close(end)
    seen = b""
    while True:
        try:
            data = os.read(main, 4096)
        except OSError:
            break
        if not data:
            break
        seen += data
    os.close(main)
    assert process.wait(timeout=60) == 0, seen.decode()
    assert b"\rslow[mujoco]  " in seen
    assert b" 90 %" in seen or b" 80 %" in seen
    assert b"1 recorded" in seen


def test_a_log_file_shows_no_progress_of_work_that_takes_seconds(slow) -> None:
    result = slow.run_apart("--twin-update", "-k", "slow")
    assert " %\n" not in result.stdout.str().replace("100%", "")
    assert "\r" not in result.stdout.str()
    assert result.ret == 0


def test_a_log_file_shows_the_progress_of_long_work_each_minute(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(INNER)
    told = [
        line for line in pytester.runpytest_subprocess().outlines
        if line.startswith("diagnosis of arm")
    ]  # fmt: skip
    assert told == [
        "diagnosis of arm  20 % after 1 min, about 4 min left",
        "diagnosis of arm  40 % after 2 min, about 3 min left",
    ]
