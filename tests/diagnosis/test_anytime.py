"""A diagnosis has a result within seconds, at the end of its time and after Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from two_pendulums import JOINTS, case

from pytest_twin import cli
from pytest_twin.diagnosis.first_answer import first_answer
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.loaded_model import load_model

LEFT = JOINTS[:1]
PROGRAM = str(Path(sys.executable).with_name("pytest-twin"))


def read_diagnosis(folder: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((folder / "out" / "diagnosis.json").read_text())
    return loaded


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_the_search_and_writes_the_best_result_so_far(
    tmp_path: Path, number: signal.Signals
) -> None:
    words = case(tmp_path, joints=LEFT, viscous=0.1)
    command = [PROGRAM, "diagnose", *words, "--seconds", "1000", "--out", str(tmp_path / "out")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        first = process.stderr.readline()
        assert first.startswith("first answer, from one recording: ")
        if number == signal.SIGTERM:
            # A scheduler signals every process of a job.
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
            for child in children.read_text().split() if children.exists() else ():
                os.kill(int(child), number)
        process.send_signal(number)
        rest = process.stderr.read()
    assert "stopping: the best result so far is written; Ctrl-C again aborts" in rest
    assert process.returncode in (0, 1)
    found = read_diagnosis(tmp_path)
    assert any("because it was stopped. Not tried: " in note for note in found["notes"])
    assert found["held_out"]["left"]["rms_before"] > 0.0
    assert (tmp_path / "out" / "report.html").is_file()
    assert (tmp_path / "out" / "realization" / "model.xml").is_file()


def test_a_diagnosis_whose_time_is_over_lists_what_was_not_tried(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = case(tmp_path, joints=LEFT, viscous=0.1)
    out = str(tmp_path / "out")
    assert cli.main(["diagnose", *words, "--seconds", "0.1", "--out", out]) in (0, 1)
    found = read_diagnosis(tmp_path)
    (note,) = [n for n in found["notes"] if n.startswith("the search ended early")]
    assert "because its 0.1 processor seconds were over. Not tried: " in note
    assert all(part in note for part in found["not_tried"])
    assert "With more time (--seconds) further effects could be found" in note
    shown = capsys.readouterr().out
    assert note in shown
    # The search ended early, so it did not show that no known effect explains the residual.
    assert found["verdict"] == "unexplained"
    assert shown.startswith("Unexplained so far: the model is wrong, and the search ended before")


@pytest.mark.parametrize("seconds", ["-1", "soon", "nan", "1e9"])
def test_an_invalid_time_limit_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: str
) -> None:
    words = ["diagnose", "model.xml", "a.mcap", f"--seconds={seconds}", "--out", str(tmp_path)]
    with pytest.raises(SystemExit) as refused_effects:
        cli.main(words)
    assert refused_effects.value.code == 2
    assert f"got '{seconds}', expected processor seconds, 0 to 604800" in capsys.readouterr().err


def test_the_first_answer_names_the_effect_and_is_empty_without_time(tmp_path: Path) -> None:
    words = case(tmp_path, joints=LEFT, viscous=0.3)
    loaded = load_model(Path(words[0]))
    trials = read_trials([Path(w) for w in words[1:]], [], loaded.topics,
                         loaded.realization.structure)  # fmt: skip
    answer = first_answer(loaded.realization, trials.fit, None, seconds=600.0)
    assert answer is not None
    assert [s.place for s in answer.likely_effects] == [("viscous_friction", ("left",))]
    assert first_answer(loaded.realization, trials.fit, None, seconds=1e-6) is None
