"""Diagnosis of several robots with one command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from two_pendulums import case

from pytest_twin.commands.fleet import Options, Outcome, Robot, outcomes_of, read_fleet
from pytest_twin.errors import SpecError
from pytest_twin.formats.schema import load_schema


def pytest_twin(*words: object) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).with_name("pytest-twin")), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_each_robot_gets_an_output_folder_and_a_missing_model_stops_no_other_robot(
    tmp_path: Path,
) -> None:
    _, *recordings = case(tmp_path / "good", joints=("left",))
    names = ", ".join(f"good/{Path(r).name}" for r in recordings)
    (tmp_path / "fleet.yaml").write_text(
        f"robots:\n  good: {{model: good/model.xml, recordings: [{names}]}}\n"
        f"  bad: {{model: missing.xml, recordings: [{names}]}}\n"
    )
    done = pytest_twin(
        "diagnose", "--fleet", tmp_path / "fleet.yaml", "--out", tmp_path / "out", "--jobs", 2
    )
    assert done.returncode == 2, done.stderr
    results = json.loads((tmp_path / "out" / "fleet.json").read_text())
    jsonschema.validate(results, load_schema("results/fleet.schema.json"))
    robots = results["robots"]
    assert robots["good"]["verdict"] == "no_mismatch"
    assert (tmp_path / "out" / "good" / "diagnosis.json").is_file()
    assert robots["bad"]["verdict"] is None
    assert "no such model" in robots["bad"]["error"]
    assert "bad   not diagnosed: " in done.stdout
    assert not (tmp_path / "out" / "bad").exists()


class ReversedExecutor:
    """An executor that runs the last item first."""

    def map(self, function, items):
        return [function(item) for item in reversed(items)][::-1]


def test_outcomes_have_the_order_of_the_robots_with_any_executor(tmp_path: Path) -> None:
    robots = [Robot(name, tmp_path / f"{name}.xml", (tmp_path / "a.mcap",)) for name in "abc"]
    outcomes = outcomes_of(robots, Options(tmp_path / "out"), ReversedExecutor())
    assert [o.name for o in outcomes] == ["a", "b", "c"]
    assert all(isinstance(o, Outcome) and o.verdict is None for o in outcomes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robots: []", "not a fleet"),
        ("robots: {a: {model: m.xml}}", r"robots\.a: wrong fields"),
        ("robots: {a: {model: m.xml, recordings: []}}", r"robots\.a\.recordings: no recording"),
        ("robots: {a: {model: m.xml, recordings: r.mcap}}", r"recordings: not files"),
        ("robots: {a/b: {model: m.xml, recordings: [r.mcap]}}", "not a folder name"),
        ("robots: {a: {model: 3, recordings: [r.mcap]}}", r"robots\.a\.model: not a file"),
    ],
)
def test_the_error_for_an_invalid_fleet_file_names_the_field(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(text)
    with pytest.raises(SpecError, match=message):
        read_fleet(path)


def test_paths_are_relative_to_the_fleet_file(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text(
        "robots: {a: {model: m.xml, recordings: [r.mcap], held_out: [h.mcap]}}"
    )
    assert read_fleet(tmp_path / "fleet.yaml") == [
        Robot("a", tmp_path / "m.xml", (tmp_path / "r.mcap",), (tmp_path / "h.mcap",))
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "o"], "nothing to diagnose"),
        (["m.xml", "--fleet", "f.yaml", "--out", "o"], "cannot be combined"),
        (
            ["m.xml", "r.mcap", "--out", "o", "--jobs", "2"],
            "--jobs, --scheduler: only for a fleet",
        ),
    ],
    ids=["no input", "model and fleet", "jobs without a fleet"],
)
def test_arguments_that_exclude_each_other_give_a_message_of_one_line(
    words: list[str], message: str
) -> None:
    done = pytest_twin("diagnose", *words)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
