"""The table of thresholds: what half and twice of each number changes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba", reason="the plant is compiled: pip install 'pytest-twin[benchmarks]'")
sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import sensitivity
from sensitivity import Answers, Case, Field, Traced

BENCHMARKS = Path(sensitivity.__file__).parent
FIELDS = sensitivity.settings_fields()
EVEN, EARNS = (
    next(field for field in FIELDS if field.name == name)
    for name in ("VelocitySettings.even", "SearchSettings.earns")
)
USUAL = {"verdict": "explained", "findings": {"delay": {"delay": 0.02}}, "simulations": 9}


def row(field: Field, altering: set[tuple[str, float]], answers: Answers) -> str | None:
    trace = {"one": Traced(frozenset({field.name}), frozenset(altering))}
    return sensitivity.row(field, answers, {"one": USUAL}, trace, sensitivity.Counter())


def test_fields_of_the_search_are_among_those_that_are_measured() -> None:
    assert {f.name.partition(".")[0] for f in FIELDS} >= {
        "SearchSettings",
        "UnitSettings",
    }


def test_a_change_that_alters_no_comparison_needs_no_run(tmp_path: Path) -> None:
    line = row(EARNS, set(), Answers(tmp_path / "answers.jsonl"))
    assert line == "| `SearchSettings.earns` | 5 | 0 | 1 |  | same | same |"


def test_a_change_that_may_alter_the_result_is_listed_after_its_run(tmp_path: Path) -> None:
    answers = Answers(tmp_path / "answers.jsonl")
    altering = {(EARNS.name, 0.5)}
    assert row(EARNS, altering, answers) is None
    other = USUAL | {"findings": {"friction": {"coulomb": 0.1}}}
    answers.add("one", EARNS.name, 2.5, other)
    stored = Answers(tmp_path / "answers.jsonl")
    line = row(EARNS, altering, stored)
    assert line == "| `SearchSettings.earns` | 5 | 0 | 1 | 1 of 1 | one: names friction | same |"


def test_a_stopped_measurement_goes_on_with_the_stored_result_of_a_case(tmp_path: Path) -> None:
    runs = []

    def diagnosed(folder: Path) -> dict[str, object]:
        runs.append(folder)
        return USUAL | {"simulations": int(EARNS.owner.earns > 1.0)}

    case = Case("one", lambda folder: folder.mkdir(parents=True), diagnosed)
    first = sensitivity.usual_result(case, FIELDS, tmp_path)
    assert first.traced == Traced(frozenset({EARNS.name}), frozenset())
    assert len(runs) == 2, "once as usual, once with the fields followed"
    assert sensitivity.usual_result(case, FIELDS, tmp_path) == first
    assert len(runs) == 2


def test_tests_that_depend_on_a_field_are_counted(tmp_path: Path) -> None:
    """One comparison changes with half of the number, one with neither half nor twice."""
    test = tmp_path / "test_threshold.py"
    test.write_text(
        "from pytest_twin.diagnosis.signal_meaning.settings import RECORDED_VELOCITY as S\n"
        f"def test_near(): assert {0.9 * EVEN.value} < S.even\n"
        f"def test_far(): assert {0.1 * EVEN.value} < S.even\n"
    )
    script = str(BENCHMARKS / "shown_by_tests.py")
    for _ in range(2):  # the second run has nothing to do
        done = subprocess.run(
            [sys.executable, script, "--out", str(tmp_path / "out"), str(test)],
            cwd=BENCHMARKS.parent, capture_output=True, text=True, check=True,
        )  # fmt: skip
    assert "no tests ran" in done.stdout, done.stdout + done.stderr
    (path,) = (tmp_path / "out").glob("*/tests.jsonl")
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    assert [entry["altering"] for entry in entries] == [[[EVEN.name, 0.5]], []]
    assert sensitivity.tests_of_fields(path.parent) == {EVEN.name: 1}
