"""A short sample of the blind cases: hidden effects are found, and none where none is hidden.

These are development seeds; the table in the README uses other seeds.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba", reason="the plant is compiled: pip install 'pytest-twin[benchmarks]'")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "concealed"))

import cases
import run


@pytest.mark.parametrize(
    ("seed", "hidden", "seconds"),
    # An effect is found in recordings of half the benchmark's length. Without one the full length
    # is quicker: it leaves no doubt, and nothing is searched.
    [
        pytest.param(5015, "command_delay", 6.0, marks=pytest.mark.nightly),
        (5023, "joint_spring", 6.0),
        (5026, None, 12.0),
    ],
)
def test_the_diagnosis_finds_exactly_the_hidden_effect(
    seed: int, hidden: str | None, seconds: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cases, "DURATION", seconds)
    name = cases.make(seed, tmp_path / "cases", tmp_path / "truth")
    # One motion to fit and one held out suffice here and take half of the time.
    for unused in ("1_moves", "2_slow", "3_steps"):
        (tmp_path / "cases" / name / "recordings" / f"{unused}.mcap").unlink()
    # Relative folders, as in the command of the README.
    monkeypatch.chdir(tmp_path)
    told = run.diagnose(Path("cases") / name, Path(name), seconds=300.0)
    assert told["status"] == 0, told
    truth = json.loads((tmp_path / "truth" / f"{name}.json").read_text())
    said = json.loads((tmp_path / name / "diagnosis.json").read_text())
    named = [(f["effect"], f["joint"]) for f in said["findings"]]
    assert named == [(e["effect"], e["joint"]) for e in truth["effects"]]
    if hidden is None:
        assert said["verdict"] == "no_mismatch"
        return
    assert named[0][0] == hidden
    for parameter, value in truth["effects"][0]["parameters"].items():
        estimate = said["findings"][0]["parameters"][parameter]
        assert estimate["value"] == pytest.approx(value, rel=0.03)
