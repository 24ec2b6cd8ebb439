"""Comparison with mujoco.sysid: one line per case, and no case is fitted twice."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco.sysid", reason="pip install 'pytest-twin[benchmarks]'")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import usual_way


def errors(before: float, after: float) -> dict[str, dict[str, float]]:
    return {"j": {"rms_before": before, "rms_after": after, "floor": 0.001}}


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Two cases: in the first both methods improve the model, in the second mujoco.sysid fails."""
    (tmp_path / "truth").mkdir()
    for case, after in (("case1", 0.05), ("case2", np.inf)):
        (tmp_path / "cases" / case).mkdir(parents=True)
        (tmp_path / "results" / case).mkdir(parents=True)
        said = {"held_out": errors(0.1, 0.001)}
        (tmp_path / "results" / case / "diagnosis.json").write_text(json.dumps(said))
        hidden: dict[str, Any] = {"effects": [{"effect": "command_delay"}], "outside": None}
        (tmp_path / "truth" / f"{case}.json").write_text(json.dumps(hidden))
        with (tmp_path / "usual.jsonl").open("a") as file:
            file.write(json.dumps({"case": case, "held_out": errors(0.1, after)}) + "\n")
    return tmp_path


def test_both_methods_are_compared_on_the_same_held_out_error(place: Path) -> None:
    text = usual_way.table(place / "usual.jsonl", place / "results", place / "truth")
    # Remaining squared error above the noise floor: (0.05^2 - 0.001^2) / (0.1^2 - 0.001^2).
    usual, ours = "0.1 -> 0.05 (0.001) | 75.0%", "0.1 -> 0.001 (0.001) | 100.0%"
    assert f"| case1 | command_delay | {usual} | {ours} |" in text
    assert any("| case2 |" in line and "| diverged |" in line for line in text)


def test_cases_with_a_result_are_not_fitted_again(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "cases" / "case3").mkdir()
    asked: list[str] = []
    monkeypatch.setattr(usual_way, "fit_all", lambda cases, *_: asked.extend(c.name for c in cases))
    folders = {"cases": "cases", "results": "results", "truth": "truth", "out": "usual.jsonl"}
    given = [word for k, v in folders.items() for word in (f"--{k}", str(place / v))]
    monkeypatch.setattr(sys, "argv", ["usual_way.py", *given])
    usual_way.main()
    assert asked == ["case3"]
    assert "case1" in capsys.readouterr().out
