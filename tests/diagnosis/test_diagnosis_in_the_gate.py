"""Diagnosis of goldens that fail against their recordings; with the patched model they pass."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from in_process import forked_pytest
from two_pendulums import case

JOINTS = ("elbow",)
GOLDEN = """\
schema: 1
kind: replay
title: {name}
target: {{recording: recordings/{name}.mcap}}
tolerance: {{angle_rms: 3 mrad}}
"""


def run(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run pytest in the folder of a twin, with options that start or change processes apart."""
    environment = os.environ | {"HOME": str(root.parent)}
    if not {"-p", "-n"} & {*arguments}:
        return forked_pytest("-p", "no:cacheprovider", *arguments, cwd=root, env=environment)
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments],
        cwd=root,
        env=environment,
        capture_output=True,
        text=True,
        timeout=100,
    )


def twin(root: Path, **hidden: float) -> Path:
    """Write a twin with one joint and three recordings of its robot; two of them have a golden."""
    recordings = root / "recordings"
    case(recordings, joints=JOINTS, seconds=2.2, **hidden)
    (recordings / "model.xml").rename(root / "model.xml")
    (root / "twin.yaml").write_text(
        "name: arm\nmodel: model.xml\nretired: {golden/asset/audit: it has its own tests}\n"
    )
    folder = root / "golden" / "replay"
    folder.mkdir(parents=True)
    for name in ("fit1", "held_out3"):
        (folder / f"{name}.yaml").write_text(GOLDEN.format(name=name))
    result = run(root, "--twin-update")
    assert "2 recorded" in result.stdout, result.stdout + result.stderr
    return root


@pytest.fixture(scope="module")
def delayed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A twin of a robot with a command delay of 20 ms."""
    return twin(tmp_path_factory.mktemp("delayed") / "arm", delay=0.02)


def quick_diagnoses(text: str) -> list[str]:
    return re.findall(r"^  diagnosis \(quick\): (.*)$", text, re.MULTILINE)


def test_a_failed_replay_names_the_likely_effect_in_one_line(delayed: Path) -> None:
    result = run(delayed)
    assert result.returncode == 1
    lines = quick_diagnoses(result.stdout)
    assert len(lines) == 2
    for line in lines:
        # The confidence depends on the recording: at most 90 % alone, or with an alternative.
        found = re.fullmatch(
            r"(?:probably command delay at joint elbow: command delay about (\d+) ms; "
            r"confidence (\d+) %; correcting it"
            r"|could be command delay at joint elbow \(command delay about (\d+) ms\) "
            r"or sensor delay; correcting the first) would remove (\d+) % of the squared error; "
            r"full diagnosis: pytest --twin-diagnose",
            line,
        )
        assert found, line
        alone, confidence, hedged, removed = found.groups()
        assert int(alone or hedged) in (19, 20, 21)
        assert alone is None or 50 <= int(confidence) <= 90
        assert int(removed) >= 95
    page = (delayed / ".twin" / "report.html").read_text()
    named = re.findall(
        r"Diagnosis \(quick\): (?:probably|could be) command delay at joint elbow", page
    )
    assert len(named) == 2
    assert not (delayed / ".twin" / "diagnosis").exists()


def test_friction_is_named_for_the_failed_golden_only(tmp_path: Path) -> None:
    root = twin(tmp_path / "arm", viscous=0.05)
    golden = root / "golden" / "replay" / "fit1.yaml"
    golden.write_text(golden.read_text().replace("3 mrad", "3000 mrad"))
    result = run(root)
    assert "1 failed, 1 passed" in result.stdout
    (line,) = quick_diagnoses(result.stdout)
    assert line.startswith("probably viscous friction at joint elbow: viscous friction about 0.05 ")


def run_without_quick_diagnosis(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run pytest where a quick diagnosis fails at once, which saves a second for each golden."""
    (root / "broken_diagnosis.py").write_text(
        "from pytest_twin.realization.sandbox import Sandbox\n"
        "call = Sandbox.call\n"
        "def other(self, function, *rest, **more):\n"
        "    return call(self, function.replace('quick_diagnosis', 'no_such'), *rest, **more)\n"
        "Sandbox.call = other\n"
    )
    return run(root, "-p", "broken_diagnosis", *arguments)


def test_a_quick_diagnosis_that_raises_an_error_prints_one_line(
    delayed: Path, tmp_path: Path
) -> None:
    root = tmp_path / "arm"
    shutil.copytree(delayed, root)
    result = run_without_quick_diagnosis(root)
    assert "2 failed" in result.stdout
    for line in quick_diagnoses(result.stdout):
        assert line.startswith("could not be made: ")
        assert "no_such" in line


STORED = """\
import json, pathlib, shutil
from pytest_twin.realization.sandbox import Sandbox
call = Sandbox.call
stored = pathlib.Path({folder!r})
def stored_call(self, function, arguments, **more):
    if function != "pytest_twin.gate.worker:diagnose":
        return call(self, function, arguments, **more)
    if stored.is_dir():
        shutil.copytree(stored / "out", arguments["out"], dirs_exist_ok=True)
        return json.loads((stored / "answer.json").read_text())
    answer = call(self, function, arguments, **more)
    shutil.copytree(arguments["out"], stored / "out")
    (stored / "answer.json").write_text(json.dumps(answer))
    return answer
Sandbox.call = stored_call
"""
"""Plugin that stores the result of the first diagnosis for all later ones."""


def diagnosed_copy(delayed: Path, folder: Path, *arguments: str) -> tuple[Path, str]:
    """A copy of the twin after a full diagnosis, and the output of the run."""
    root = folder / "arm"
    shutil.copytree(delayed, root)
    shutil.rmtree(root / ".twin", ignore_errors=True)
    (root / "stored.py").write_text(STORED.format(folder=str(delayed.parent / "stored")))
    text = run(root, "-p", "stored", "--twin-diagnose", *arguments).stdout
    (root / "stored.py").unlink()
    shutil.rmtree(root / "__pycache__", ignore_errors=True)
    return root, text


@pytest.fixture(scope="module")
def diagnosed(delayed: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    return diagnosed_copy(delayed, tmp_path_factory.mktemp("diagnosed"))


def assert_attached(root: Path, text: str) -> None:
    assert "2 failed" in text
    folder = root / ".twin" / "diagnosis" / "mujoco"
    diagnosis = json.loads((folder / "diagnosis.json").read_text())
    assert [f["effect"] for f in diagnosis["findings"]] == ["command_delay"]
    assert diagnosis["trials"] == {
        "fit": ["fit1.mcap"],
        "held_out": ["held_out3.mcap"],
    }
    assert text.count("diagnosing mujoco over 2 recordings") == 1
    assert text.count("--- diagnosis ---") == 2
    assert text.count("The command delay of joint elbow is ") == 1
    assert "see golden/replay/fit1@mujoco" in text
    assert "diagnosis of mujoco: Explained" in text
    assert str(folder / "report.html") in text
    assert "full diagnosis:" not in text
    page = (root / ".twin" / "report.html").read_text()
    assert page.count('<a href="diagnosis/mujoco/report.html">Full diagnosis</a>') == 2


def test_the_full_diagnosis_is_attached_to_the_failures(diagnosed: tuple[Path, str]) -> None:
    assert_attached(*diagnosed)


def test_with_xdist_the_controller_makes_the_diagnosis(
    diagnosed: tuple[Path, str], delayed: Path, tmp_path: Path
) -> None:
    assert_attached(*diagnosed_copy(delayed, tmp_path, "-n", "2"))


def test_the_patched_model_passes_where_the_nominal_model_failed(
    diagnosed: tuple[Path, str], tmp_path: Path
) -> None:
    root = tmp_path / "arm"
    shutil.copytree(diagnosed[0], root)
    shutil.copytree(root / ".twin" / "diagnosis" / "mujoco", root / "why")
    (root / "twin.yaml").write_text(
        "name: arm\nrealizations:\n  mujoco: {file: model.xml}\n  patched: {file: why}\n"
    )
    for spec in (root / "golden" / "replay").glob("*.yaml"):
        both = "realizations: [mujoco, patched]\ntitle:"
        spec.write_text(spec.read_text().replace("title:", both))
    text = run_without_quick_diagnosis(root).stdout
    assert "2 failed, 2 passed" in text, text
    for line in text.splitlines():
        assert not (line.startswith("FAILED") and "patched" in line)


def test_goldens_of_a_patched_model_are_stale_when_its_effects_change(
    diagnosed: tuple[Path, str], tmp_path: Path
) -> None:
    root = tmp_path / "arm"
    shutil.copytree(diagnosed[0], root)
    shutil.copytree(root / ".twin" / "diagnosis" / "mujoco", root / "why")
    (root / "twin.yaml").write_text("name: arm\nmodel: why\n")
    result = run_without_quick_diagnosis(root, "--twin-release")
    assert result.returncode == 0, result.stdout[-1500:]
    assert "2 passed" in result.stdout, result.stdout
    effects = root / "why" / "realization" / "effects.json"
    effects.write_text(effects.read_text().replace('"delay": 0.0', '"delay": 0.01'))
    text = run_without_quick_diagnosis(root).stdout
    assert "2 stale" in text, text
    assert "2 passed" in text, "the MJCF contains the delay, and effects.json only documents it"
    model = root / "why" / "realization" / "model.xml"
    delayed, count = re.subn(r' delay="0\.0[^"]*"', ' delay="0.01"', model.read_text())
    assert count == 1
    model.write_text(delayed)
    text = run_without_quick_diagnosis(root).stdout
    assert "2 failed" in text, text
    reasons = text[text.index("ran because") :]
    assert " mujoco/effects: sha256" in reasons, text
