"""A short sample of the blind cases: what is hidden is named, and nothing where nothing is.

Development seeds; the table in the README rests on others.
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
    ("seed", "hidden"),
    [(5015, "command_delay"), (5023, "joint_spring"), (5026, None)],
)
def test_what_is_hidden_is_named(
    seed: int, hidden: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = cases.make(seed, tmp_path / "cases", tmp_path / "truth")
    # One motion to fit and one to test on say the same as all five, in half of the time.
    for unused in ("1_moves", "2_slow", "3_steps"):
        (tmp_path / "cases" / name / "recordings" / f"{unused}.mcap").unlink()
    # Folders as a user gives them: the README's command has them relative.
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
