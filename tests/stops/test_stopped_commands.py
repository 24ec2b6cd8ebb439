"""A signal to every process of a job ends each estimating command with its best answer."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jsonschema
import psutil
import pytest
from estimating_commands import INPUTS, Estimating

from pytest_twin.formats.schema import load_schema

PROGRAM = str(Path(sys.executable).with_name("pytest-twin"))
Moment = Callable[[psutil.Process, Path], bool]


def _descendants(process: psutil.Process) -> list[psutil.Process]:
    with contextlib.suppress(psutil.NoSuchProcess):
        return process.children(recursive=True)
    return []


def has_children(process: psutil.Process, out: Path) -> bool:
    """Before the first answer: the child process has just started."""
    return bool(_descendants(process))


def is_computing(process: psutil.Process, out: Path) -> bool:
    """In the middle of the work."""
    used = 0.0
    for child in _descendants(process):
        with contextlib.suppress(psutil.NoSuchProcess):
            used = max(used, sum(child.cpu_times()[:2]))
    return used > 2.0


def is_writing(process: psutil.Process, out: Path) -> bool:
    """While the files of the result are written."""
    return any(out.parent.rglob("realization/model.xml")) or any(out.glob("*/realization"))


def run_and_signal(
    command: Estimating, out: Path, number: signal.Signals, moment: Moment
) -> tuple[int, str]:
    """Send a signal to the process group of a command and to every child, as CI does."""
    with subprocess.Popen(
        [PROGRAM, *command.words, "--out", str(out)],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    ) as started:  # fmt: skip
        process = psutil.Process(started.pid)
        end = time.monotonic() + 120.0
        while started.poll() is None and time.monotonic() < end and not moment(process, out):
            time.sleep(0.02)
        everything = _descendants(process)
        # A fast machine may be done.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(started.pid, number)
        for child in everything:
            with contextlib.suppress(psutil.NoSuchProcess):
                child.send_signal(number)
        _, said = started.communicate(timeout=240.0)
    gone = psutil.wait_procs(everything, timeout=20.0)[1]
    assert not gone, "every child ends with the command"
    return started.returncode, said


@pytest.mark.parametrize(
    ("name", "number", "moment"),
    [
        ("identify", signal.SIGTERM, has_children),
        ("identify", signal.SIGINT, is_computing),
        ("diagnose", signal.SIGTERM, is_writing),
        pytest.param("randomize", signal.SIGTERM, is_computing, marks=pytest.mark.nightly),
        ("excite", signal.SIGTERM, is_computing),
        ("budget", signal.SIGTERM, has_children),
    ],
)
def test_a_signal_to_every_process_gives_the_best_answer(
    tmp_path: Path, name: str, number: signal.Signals, moment: Moment
) -> None:
    command, out = INPUTS[name](tmp_path), tmp_path / "out"
    status, said = run_and_signal(command, out, number, moment)
    assert status in (0, 1), said
    document = json.loads((out / command.result).read_text())
    schema = {"diagnose": "diagnosis"}.get(name, name)
    jsonschema.validate(document, load_schema(f"results/{schema}.schema.json"))
    if moment is has_children:
        assert "stopping: " in said
        assert document["not_tried"]
    if document["not_tried"]:
        assert document["verdict"] != command.complete
    assert not list(tmp_path.glob(".pytest-twin-*")), "no temporary folder stays"


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGTERM, marks=pytest.mark.nightly), signal.SIGINT]
)
def test_a_stopped_fleet_lists_the_robots_that_it_did_not_try(
    tmp_path: Path, number: signal.Signals
) -> None:
    command, out = INPUTS["fleet"](tmp_path), tmp_path / "out"
    status, said = run_and_signal(command, out, number, is_computing)
    assert status == 1, said
    document = json.loads((out / "fleet.json").read_text())
    jsonschema.validate(document, load_schema("results/fleet.schema.json"))
    assert set(document["robots"]) == {"one", "two", "three"}
    assert document["not_tried"] == ["three"]
    for robot, entry in document["robots"].items():
        assert (out / robot / "diagnosis.json").is_file() is (entry["verdict"] is not None)
