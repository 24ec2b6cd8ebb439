"""The yardstick: answers are stored whole, compared by one definition, and missing inputs said."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import yardstick
from frozen import answer as answers
from frozen import one_law
from frozen.comparison import Judged, worse
from frozen.problem import Inputs, MissingInputError, Problem, outside

TRUTH = {
    "effects": [
        {
            "effect": "viscous_friction", "joint": "elbow", "parameters": {"coefficient": 0.6},
            "visibility": 40.0, "equivalents": [],
        }
    ],
    "background": [],
}  # fmt: skip


def finding(effect: str, confidence: float, *others: tuple[str, float]) -> dict[str, Any]:
    return {
        "effect": effect, "joint": "elbow", "confidence": confidence, "parameters": {},
        "alternatives": [{"effect": e, "joint": "elbow", "confidence": c} for e, c in others],
    }  # fmt: skip


def answered(
    *findings: dict[str, Any], after: float = 1.5e-4, before: float = 4e-3,
    simulations: float = 100.0, truth: dict[str, Any] = TRUTH,
) -> Judged:  # fmt: skip
    answer = {
        "verdict": "explained", "findings": list(findings), "simulations": simulations,
        "held_out": {"elbow": {"rms_before": before, "rms_after": after, "floor": 1e-4}},
        "processor_seconds": 9.0, "status": 0,
    }  # fmt: skip
    return Judged(answer, truth)


DAMPING = finding("viscous_friction", 0.95)
RIGHT = answered(DAMPING)


def test_an_equal_answer_is_not_worse() -> None:
    assert worse(RIGHT, RIGHT) == []


@pytest.mark.parametrize(
    ("new", "reason"),
    [
        (answered(finding("payload", 0.5)), "first name"),
        (answered(DAMPING, finding("payload", 0.9)), "1 false names at 0.9 instead of 0"),
        (answered(DAMPING, after=1.6e-4), "held-out error times 1.07"),
        (answered(DAMPING, simulations=120.0), "120 simulations instead of 100"),
        (Judged({"status": -9}, TRUTH), "no result"),
    ],
)
def test_each_way_to_be_worse_is_said(new: Judged, reason: str) -> None:
    (said,) = worse(RIGHT, new)
    assert reason in said


def test_errors_below_the_noise_floor_are_equal() -> None:
    assert worse(answered(DAMPING, after=2e-5), answered(DAMPING, after=9e-5)) == []


def test_errors_on_other_samples_are_compared_by_replay_of_the_written_models() -> None:
    """A shorter window always has a smaller error."""
    old, new = answered(DAMPING, after=3e-4), answered(DAMPING, after=2e-4, before=1e-3)
    for judged, level in ((old, 5e-4), (new, 9e-4)):
        judged.answer["replayed"] = {"steps": {"elbow": [level, level]}}
    (said,) = worse(old, new)
    assert "held-out error times 1.8" in said


def test_a_law_alone_may_share_its_confidence_with_laws_that_predict_the_same() -> None:
    truth: dict[str, Any] = json.loads(json.dumps(TRUTH)) | {"family": "one_law"}
    truth["effects"][0]["equivalents"] = [["controller_gain", "elbow"]]
    shared = finding("controller_gain", 0.5, ("viscous_friction", 0.49))
    assert answered(DAMPING, truth=truth).is_alone
    assert answered(shared, truth=truth).is_alone
    assert not answered(finding("viscous_friction", 0.6), truth=truth).is_alone
    third = finding("viscous_friction", 0.5, ("payload", 0.5))
    assert not answered(third, truth=truth).is_alone
    assert not answered(DAMPING, finding("payload", 0.3), truth=truth).is_alone


def test_a_killed_run_leaves_whole_lines_and_the_next_one_continues(tmp_path: Path) -> None:
    file = tmp_path / "answers.jsonl"
    answers.append(file, {"row": "a", "value": 0.1234567})
    with file.open("a") as stream:
        stream.write('{"row": "b", "val')
    assert answers.read(file) == {"a": {"row": "a", "value": 0.12346}}
    answers.append(file, {"row": "c", "value": float("nan")})
    assert list(answers.read(file)) == ["a", "c"]
    assert answers.read(file)["c"]["value"] is None


def test_missing_inputs_name_the_variable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("TWIN_PROBLEMS", raising=False)
    with pytest.raises(MissingInputError, match="set TWIN_PROBLEMS"):
        outside("TWIN_PROBLEMS", "table")
    monkeypatch.setenv("TWIN_PROBLEMS", str(tmp_path))
    with pytest.raises(MissingInputError, match="no table in"):
        outside("TWIN_PROBLEMS", "table")


DIAGNOSIS = {
    "verdict": "explained",
    "findings": [{**DAMPING, "alternatives": []}],
    "held_out": {"elbow": {"rms_before": 4e-3, "rms_after": 1e-4, "floor": 1e-4, "unit": "rad"}},
    "trials": {"fit": ["fit.csv"], "held_out": []},
    "cost": {"simulations": 12.0},
}


@pytest.fixture
def other_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A search that is no command: it writes a fixed diagnosis."""
    (tmp_path / "other_search.py").write_text(
        "import json, pathlib\n"
        "def main(words):\n"
        "    out = pathlib.Path(words[words.index('--out') + 1])\n"
        "    out.mkdir()\n"
        f"    (out / 'diagnosis.json').write_text({json.dumps(json.dumps(DIAGNOSIS))})\n"
        "    return 0\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "other_search:main"


def test_rows_run_another_search_once_and_only_on_frozen_inputs(
    other_search: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def write(folder: Path) -> Inputs:
        folder.mkdir(parents=True)
        for name in ("model.xml", "fit.csv"):
            (folder / name).write_text(name)
        return Inputs(folder / "model.xml", [folder / "fit.csv"], truth=TRUTH)

    problem = Problem("drawn/1", "diagnose", write, ("none",))
    changed = replace(problem, name="drawn/2")

    def every() -> Sequence[Problem]:
        return [problem, changed]

    monkeypatch.setattr(yardstick, "problems", every)
    monkeypatch.setattr(yardstick, "DIGESTS", tmp_path / "digests.json")

    def call(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["yardstick.py", *words])
        return yardstick.main()

    file, work = tmp_path / "answers.jsonl", ("--work", str(tmp_path / "work"))
    call("freeze", *work)
    frozen = json.loads((tmp_path / "digests.json").read_text())
    frozen["drawn/2"]["digest"] = "of other inputs"
    (tmp_path / "digests.json").write_text(json.dumps(frozen))
    for _ in range(2):
        call("run", *work, "--answers", str(file), "--entry", other_search)
    (answer,) = answers.read(file).values()
    assert len(file.read_text().splitlines()) == 1
    stale_file = tmp_path / "stale.jsonl"
    answers.append(stale_file, {**answer, "digest": "of other inputs", "verdict": "unexplained"})
    call("run", *work, "--answers", str(stale_file), "--entry", other_search)
    assert answers.read(stale_file)["drawn/1@none"]["verdict"] == "explained"
    assert (answer["row"], answer["entry"]) == ("drawn/1@none", other_search)
    assert (answer["simulations"], answer["verdict"]) == (12.0, "explained")
    said = capsys.readouterr().out
    assert said.count("drawn/2@none: skipped: its inputs are not the frozen ones") == 3
    assert call("compare", str(file), str(file)) == 0
    assert "| drawn, limit none | first name right | 1 of 1 | 1 of 1 |" in capsys.readouterr().out
    worse_file = tmp_path / "worse.jsonl"
    answers.append(worse_file, {**answer, "findings": [finding("payload", 0.95)]})
    assert call("compare", str(file), str(worse_file)) == 1


def test_a_drawn_law_changes_the_readings_by_ten_times_their_noise_and_is_the_same_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The law may share its name only with laws that predict the same."""
    monkeypatch.setattr(one_law, "SECONDS", 1.5)
    monkeypatch.setattr(one_law, "laws", lambda: ["command_delay", "sensor_delay"])
    first, again = (one_law.make(0, tmp_path / name) for name in ("first", "again"))
    assert first.digest() == again.digest()
    (hidden,) = first.truth["effects"]
    assert hidden["effect"] == "command_delay"
    assert hidden["visibility"] == pytest.approx(one_law.TIMES_NOISE, rel=0.1)
    assert (len(first.fit), len(first.held_out)) == (3, 1)
