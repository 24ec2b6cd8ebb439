"""Scoring of families of cases with background differences: right, background or false."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "concealed"))

import family_score
from family_score import Answer


def _finding(
    effect: str, joint: str | None, confidence: float = 0.95, value: float = 1.0,
    alternatives: list[dict[str, Any]] | None = None,
) -> dict[str, Any]:  # fmt: skip
    parameters = {"size": {"value": value, "ci95": [0.9 * value, 1.1 * value]}}
    return {"effect": effect, "joint": joint, "confidence": confidence, "parameters": parameters,
            "alternatives": alternatives or []}  # fmt: skip


def _answer(findings: list[dict[str, Any]], **truth: Any) -> Answer:
    hidden = {"effect": "command_delay", "joint": "a", "parameters": {"size": 1.0},
              "visibility": 20.0, "equivalents": [["sensor_delay", None]]}  # fmt: skip
    background = [
        {"effect": "viscous_friction", "joint": "a", "parameters": {"size": -0.01}},
        {"effect": "control_period", "joint": None, "parameters": {"period": 0.002}},
    ]
    case = {"case": "cell1", "family": "cell", "kind": "one", "joints": ["a"], "contact": False,
            "seconds": 10.0, "effects": [hidden], "outside": None, "background": background,
            **truth}  # fmt: skip
    said = {
        "verdict": "explained", "findings": findings, "unexplained": {},
        "held_out": {"a": {"rms_before": 10.0, "rms_after": 2.0, "floor": 1.0}},
        "cost": {"simulations": 100.0},
    }  # fmt: skip
    return Answer(case, {"seconds": 30.0, "status": 0}, said)


def test_a_hidden_effect_counts_as_found_only_on_its_joint() -> None:
    assert family_score.first_right(_answer([_finding("command_delay", "a")]))
    assert not family_score.first_right(_answer([_finding("command_delay", "b")]))
    assert not family_score.first_right(_answer([]))


@pytest.mark.parametrize(("share", "right"), [(0.5, True), (0.3, True), (0.02, False)])
def test_an_equivalent_effect_counts_if_the_hidden_one_has_enough_confidence(
    share: float, right: bool
) -> None:
    rival = [{"effect": "command_delay", "confidence": share}]
    answer = _answer([_finding("sensor_delay", None, 0.5, alternatives=rival)])
    assert family_score.first_right(answer) is right


def test_a_finding_is_background_if_sign_and_size_match() -> None:
    def kind(value: float) -> str:
        answer = _answer([])
        return family_score.kind_of(_finding("viscous_friction", "a", value=value), answer.truth)

    assert kind(-0.012) == "background"
    assert kind(-0.11) == "false"  # ten times the true difference: it compensates another effect
    assert kind(0.025) == "false"


def test_a_background_effect_of_all_servos_counts_at_any_joint() -> None:
    finding = _finding("control_period", "a")
    finding["parameters"] = {"period": {"value": 0.0021}}
    assert family_score.kind_of(finding, _answer([]).truth) == "background"


def test_an_unnamed_law_is_neither_right_nor_false() -> None:
    assert _answer([_finding("unnamed_law", "a")]).findings == []


def test_findings_below_90_percent_confidence_are_not_counted_as_sure() -> None:
    answer = _answer([_finding("backlash", "a", 0.89), _finding("cogging", "a", 0.9)])
    assert [f["effect"] for f in family_score.sure(answer, "false")] == ["cogging"]


def test_calibration_counts_findings_per_confidence_band() -> None:
    answer = _answer(
        [_finding("command_delay", "a", 1.0), _finding("backlash", "a", 0.8),
         _finding("cogging", "a", 0.9)]
    )  # fmt: skip
    assert family_score.calibration([answer]) == [(0, 0), (0, 1), (1, 2)]


def test_a_force_outside_the_catalogue_must_be_reported_as_unexplained() -> None:
    answer = _answer([], effects=[], kind="outside", outside={"joint": "a"})
    assert answer.said is not None
    answer.said.update(verdict="unexplained", unexplained={"a": {"fraction": 0.9}})
    assert family_score.unexplained_right(answer)
    answer.said["findings"] = [_finding("backlash", "a")]
    assert not family_score.unexplained_right(answer)


def test_tables_compare_folders_on_the_cases_that_all_have(tmp_path: Path) -> None:
    answer = _answer([_finding("command_delay", "a")])
    (tmp_path / "truth").mkdir()
    for case in ("cell1", "cell2"):
        truth = {**answer.truth, "case": case}
        (tmp_path / "truth" / f"{case}.json").write_text(json.dumps(truth))
    for column, cases in (("before", ("cell1", "cell2")), ("after", ("cell1",))):
        for case in cases:
            folder = tmp_path / column / case
            folder.mkdir(parents=True)
            (folder / "diagnosis.json").write_text(json.dumps(answer.said))
            run = tmp_path / column / f"{case}.run.json"
            run.write_text(json.dumps({**answer.run, "case": case}))
    columns = {c: family_score.load(tmp_path / "truth", tmp_path / c) for c in ("before", "after")}
    lines = family_score.table(columns)
    assert lines[0] == "| figure | goal | before | after |"
    assert lines[2] == "| cases with a result |  | 1 of 1 | 1 of 1 |"
    assert any("removed" in line and "97.0% of 1" in line for line in lines)
