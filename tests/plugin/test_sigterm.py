"""SIGTERM from CI or a scheduler ends a run as Ctrl-C does: with a report, and without children."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SLOW = """\
import time
from pathlib import Path

def test_slow():
    Path("started").touch()
    time.sleep(60)
"""


def _wait_for(path: Path) -> None:
    end = time.monotonic() + 90
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.01)
    assert path.exists()


def _start(root: Path, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options],
        cwd=root, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        # A shell starts background jobs with SIGINT ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )  # fmt: skip


def test_sigterm_ends_a_run_with_a_report(recorded) -> None:
    (recorded.root / "test_slow.py").write_text(SLOW)
    with _start(recorded.root) as process:
        _wait_for(recorded.root / "started")
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == pytest.ExitCode.INTERRUPTED
    assert "KeyboardInterrupt" in output
    assert "= twin arm =" in output
    assert (recorded.root / ".twin").is_dir()


def _children(process: int) -> list[int]:
    listed = Path(f"/proc/{process}/task/{process}/children")
    return [int(child) for child in listed.read_text().split()] if listed.exists() else []


def _is_running(process: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def test_children_end_with_a_killed_run(recorded) -> None:
    if not Path("/proc/self/task").exists():
        pytest.skip("this system has no /proc")
    (recorded.root / "test_slow.py").write_text(SLOW)
    with _start(recorded.root, "golden", "test_slow.py") as process:
        _wait_for(recorded.root / "started")
        children = _children(process.pid)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate(timeout=60)
    assert children
    end = time.monotonic() + 15
    while any(map(_is_running, children)) and time.monotonic() < end:
        time.sleep(0.1)
    assert not any(map(_is_running, children))
