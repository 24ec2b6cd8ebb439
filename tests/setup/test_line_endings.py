"""Error messages for a twin whose text files git's core.autocrlf converted to CR LF."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
import typed

pytestmark = pytest.mark.usefixtures("commands_in_process")

ROBOT = """\
<mujoco><worldbody><body name="link"><joint name="hinge" axis="0 1 0" range="-90 90"/>
<geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"/></body></worldbody>
<actuator><position name="hinge" joint="hinge" kp="50" kv="2"/></actuator></mujoco>
"""
TEXT = {".yaml", ".csv", ".xml", ".json", ".html", ".pub", ".gitignore", ".gitattributes"}


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return typed.run(*command, cwd=cwd, state=cwd.parent)


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A released twin; every text file has CR LF line endings."""
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


def test_goldens_with_a_trace_fail_and_report_the_line_endings(twin: Path) -> None:
    found = run("pytest", cwd=twin)
    assert found.returncode == 1
    failed = [line for line in found.stdout.splitlines() if line.startswith("FAILED")]
    traces = list((twin / "golden").rglob("*.trace.csv"))
    assert len(failed) == len(traces) > 1
    output = " ".join(found.stdout.split())
    assert output.count("has CR LF line endings where LF was recorded") >= len(traces)
    assert "commit a .gitattributes with '* -text'" in output


def test_verify_reports_changed_line_endings_of_files(twin: Path) -> None:
    found = run("pytest-twin", "verify", "releases/0001", cwd=twin)
    assert found.returncode == 1
    output = found.stdout + found.stderr
    assert "files/robot.xml: has CR LF line endings where LF was signed" in output


def test_verify_reports_an_added_line_ending_at_the_end_of_the_envelope(twin: Path) -> None:
    envelope = twin / "releases" / "0001" / "release.dsse.json"
    envelope.write_bytes(envelope.read_bytes() + b"\r\n")
    found = run("pytest-twin", "verify", "releases/0001", cwd=twin)
    assert found.returncode == 1
    output = found.stdout + found.stderr
    assert "the envelope has line endings that were not signed" in output
    assert "commit a .gitattributes with '* -text'" in output
