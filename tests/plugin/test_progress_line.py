"""A live line on a terminal for long work, and silence where nobody watches."""

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


def test_a_terminal_sees_the_fraction_done(slow) -> None:
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


def test_a_file_does_not(slow) -> None:
    result = slow.run_apart("--twin-update", "-k", "slow")
    assert " %\n" not in result.stdout.str().replace("100%", "")
    assert "\r" not in result.stdout.str()
    assert result.ret == 0
