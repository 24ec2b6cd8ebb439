"""Command ``pytest-twin excite``: written files, exit status and messages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from approved_arms import Excited, approved_for_arm, write_twin

from pytest_twin import cli
from pytest_twin.formats import results
from pytest_twin.formats.schema import load_schema
from pytest_twin.report import excitation as page


def is_valid(document: dict[str, Any]) -> bool:
    schema = load_schema("results/excite.schema.json")
    jsonschema.validate(document, schema)
    return set(document) <= set(schema["properties"])


def test_excite_writes_motions_report_and_abort_criteria(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = write_twin(tmp_path, approved_for_arm(mechanisms=["delay"]))
    out = tmp_path / "out"
    assert cli.main(["excite", str(twin), "--out", str(out), "--json", "-"]) == 0
    stdout, words = capsys.readouterr()
    document = json.loads(stdout)
    assert document == json.loads((out / "excitation.json").read_text())
    assert is_valid(document)
    assert document["verdict"] == "identifiable"
    for one in document["trajectories"]:
        assert all((out / name).is_file() for name in one["files"])
        assert all(margin["share"] <= 1.0 + 1e-9 for margin in one["margins"].values())
    abort = json.loads((out / "abort.json").read_text())
    assert abort["stop"]["plan"] == "enabling switch"
    assert abort["abort_when"]["joints"]["lift"]["position_outside"] == [-1.2, 1.2]
    assert abort["abort_when"]["joints"]["lift"]["effort_above"] == 12.0
    limits = abort["distance_from_command_above"]["steps_lift_fit"]["lift"]
    assert 0.02 < limits["value"] < 0.2
    assert "A qualified person" in words
    assert "never sends a command to a robot" in (out / "excitation.html").read_text()


def test_unsafe_motions_are_not_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    section = approved_for_arm(mechanisms=["delay"], supply={"voltage": 0.01, "current": 0.01})
    twin = write_twin(tmp_path, section)
    out = tmp_path / "out"
    with results.result_folder(out, "excitation.json") as staging:
        (staging / "trajectories").mkdir()
        (staging / "trajectories" / "steps_lift_fit.csv").write_text("of an earlier run\n")
    earlier = out / "trajectories" / "steps_lift_fit.csv"
    assert cli.main(["excite", str(twin), "--out", str(out)]) == 1
    words = capsys.readouterr().out
    assert "X steps_lift_fit: no safe motion in 8 attempts: power of all drives" in words
    assert "limit 0.0001 W" in words
    assert "! not identifiable: delay: no safe trajectory identifies it" in words
    document = json.loads((out / "excitation.json").read_text())
    assert is_valid(document)
    assert document["verdict"] == "not_identifiable"
    assert document["trajectories"] == []
    assert not earlier.exists()


def test_the_page_shows_every_motion_and_escapes_markup(excited: Excited) -> None:
    few = excited.document["trajectories"][:2] + excited.document["trajectories"][-1:]
    document = {**excited.document, "trajectories": few}
    drawn = {
        one["name"]: {
            "time": [0.0, 1.0],
            "joints": one["moved"],
            **{kind: [[0.0, 0.5]] * len(one["moved"]) for kind in ("position", "speed", "effort")},
        }
        for one in document["trajectories"]
    }
    abort = {
        "stop": {"category": 1, "plan": "<script>"},
        "abort_when": {
            "no_state_for": {"value": 0.1},
            "power_above": {"value": 480.0},
            "joints": {},
        },
    }
    html = page.render(document, abort, drawn)
    assert all(one["name"] in html for one in document["trajectories"])
    assert "<script>" not in html
    assert "http" not in html.replace("http-equiv", "")
