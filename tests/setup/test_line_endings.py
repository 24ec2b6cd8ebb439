"""A twin whose text files got CR LF line endings, as git's core.autocrlf makes them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

BIN = Path(sys.executable).parent
ROBOT = """\
<mujoco><worldbody><body name="link"><joint name="hinge" axis="0 1 0" range="-90 90"/>
<geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"/></body></worldbody>
<actuator><position name="hinge" joint="hinge" kp="50" kv="2"/></actuator></mujoco>
"""
TEXT = {".yaml", ".csv", ".xml", ".json", ".html", ".pub", ".gitignore", ".gitattributes"}


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    state = {"XDG_CONFIG_HOME": str(cwd.parent / "config"), "XDG_STATE_HOME": str(cwd.parent / "s")}
    return subprocess.run(
        [str(BIN / command[0]), *command[1:]],
        cwd=cwd, env={**os.environ, **state}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A released twin, with CR LF in every text file."""
    folder = tmp_path_factory.mktemp("crlf") / "twin"
    folder.mkdir()
    (folder / "robot.xml").write_text(ROBOT)
    made = run("pytest-twin", "init", "robot.xml", cwd=folder)
    assert made.returncode == 0, made.stdout + made.stderr
    released = run("pytest", "--twin-release", cwd=folder)
    assert released.returncode == 0, released.stdout[-3000:]
    assert (folder / ".gitattributes").read_text().splitlines()[-1] == "* -text"
    for path in folder.rglob("*"):
        if path.is_file() and {path.suffix, path.name} & TEXT and ".twin" not in path.parts:
            path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    return folder


def test_goldens_with_a_trace_name_the_line_endings(twin: Path) -> None:
    found = run("pytest", cwd=twin)
    assert found.returncode == 1
    failed = [line for line in found.stdout.splitlines() if line.startswith("FAILED")]
    traces = list((twin / "golden").rglob("*.trace.csv"))
    assert len(failed) == len(traces) > 1
    said = " ".join(found.stdout.split())
    assert said.count("has CR LF line endings where LF was recorded") >= len(traces)
    assert "commit a .gitattributes with '* -text'" in said


def test_verify_names_the_line_endings_of_files(twin: Path) -> None:
    found = run("pytest-twin", "verify", "releases/0001", cwd=twin)
    assert found.returncode == 1
    said = found.stdout + found.stderr
    assert "files/robot.xml: has CR LF line endings where LF was signed" in said


def test_verify_names_a_line_ending_after_the_envelope(twin: Path) -> None:
    envelope = twin / "releases" / "0001" / "release.dsse.json"
    envelope.write_bytes(envelope.read_bytes() + b"\r\n")
    found = run("pytest-twin", "verify", "releases/0001", cwd=twin)
    assert found.returncode == 1
    said = found.stdout + found.stderr
    assert "the envelope has line endings that were not signed" in said
    assert "commit a .gitattributes with '* -text'" in said
