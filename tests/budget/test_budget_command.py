"""Command ``pytest-twin budget``: written files, exit status and error messages."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from budget_files import declared, fit_record, make_twin, zeros_record
from in_process import InProcess

from pytest_twin import cli
from pytest_twin.commands import child_result
from pytest_twin.formats.schema import load_schema

SMALL = [[1e-6, 0.0], [0.0, 1e-6]]


@pytest.fixture(autouse=True)
def in_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run without a child process to save time, except in one test."""
    if request.function is not test_the_page_and_a_valid_json_file_are_written:
        monkeypatch.setattr(child_result, "Sandbox", InProcess)


def run_budget(twin: Path, status: int = 0) -> Path:
    out = twin.parent / "out"
    assert cli.main(["budget", str(twin), "--out", str(out)]) == status
    return out


def test_the_page_and_a_valid_json_file_are_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit = fit_record(["elbow.coulomb_friction"], [0.01], ["N*m"])
    more = "  tolerance: {position: 0.01, rotation: 0.02}\n"
    twin = make_twin(tmp_path, [zeros_record(SMALL)], [fit], declared(more=more))
    out = run_budget(twin)
    document = json.loads((out / "budget.json").read_text())
    jsonschema.validate(document, load_schema("results/budget.schema.json"))
    page = (out / "budget.html").read_text()
    assert page.count("<img") == 4
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    output = capsys.readouterr().out
    assert re.search(r"by the estimates: 0\.\d+ mm, 1\.\d+ mrad \(\d", output)
    assert "contact and material: not measured; pytest-twin identify" in output


def test_a_folder_is_accepted_and_json_can_go_to_standard_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_twin(tmp_path, [zeros_record(SMALL)], budget=declared())
    status = cli.main(["budget", str(tmp_path), "--out", str(tmp_path / "out"), "--json", "-"])
    assert status == 0
    document = json.loads(capsys.readouterr().out)
    assert document["output"]["frame"] == "tool"


def test_markup_in_names_is_escaped(tmp_path: Path) -> None:
    record = zeros_record(SMALL, ident="<script>alert(1)</script>")
    page = (
        run_budget(make_twin(tmp_path, [record], budget=declared())) / "budget.html"
    ).read_text()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page


@pytest.mark.parametrize(
    ("budget", "line"),
    [
        (
            "budget: {frame: tol}\n",
            "budget.frame: the model has no such frame (got 'tol'; expected",
        ),
        (
            "budget: {poses: [{elbow: 0.1, elbw: 0.2}]}\n",
            "budget.poses.0.elbw: the model has no such joint (got 'elbw'; expected",
        ),
        ("budget: {poses: [{elbow: .nan}]}\n", "budget"),
        ("budget: {tolerance: {position: -1}}\n", "budget.tolerance.position"),
        ("budget: {tolerance: {}}\n", "budget.tolerance"),
        ("budget: {owners: {weather: me}}\n", "budget.owners.weather: is not a known field"),
        ("budget: {recordings: [../../etc/passwd]}\n", "path leaves the declared roots"),
        ("budget: {recordings: [none.mcap]}\n", "no such file"),
        ("budget: {seconds: 3}\n", "budget.seconds: is not a known field"),
    ],
)
def test_an_invalid_budget_section_is_refused_with_one_line(
    tmp_path: Path, budget: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run_budget(make_twin(tmp_path, budget=budget), 2)
    (output,) = capsys.readouterr().err.strip().splitlines()
    assert output.startswith(f"pytest-twin budget: {tmp_path / 'twin.yaml'}:")
    assert line in output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        ([[1e-6, 2e-6], [2e-6, 1e-6]], "its covariance has a negative eigenvalue"),
        ([[1e-6, 5e-7], [0.0, 1e-6]], "its covariance is not symmetric"),
        ([[-1e-6, 0.0], [0.0, 1e-6]], "its covariance has a negative eigenvalue"),
        ([[1e-6, 0.0]], "a field is missing or unusable: covariance: not 2 rows of 2 numbers"),
        ([[1e-6], [1e-6]], "a field is missing or unusable: covariance: not 2 rows of 2 numbers"),
        (
            [[1e-6, "x"], [0.0, 1e-6]],
            "covariance.0.1: a field is missing or unusable (got 'x'; expected a number",
        ),
    ],
)
def test_an_invalid_covariance_is_refused(
    tmp_path: Path, matrix: list, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    record = zeros_record(np.eye(2) * 1e-6)
    record["covariance"]["matrix"] = matrix
    run_budget(make_twin(tmp_path, [record], budget=declared()), 2)
    (output,) = capsys.readouterr().err.strip().splitlines()
    assert str(tmp_path / "calibrations0.json") in output
    assert words in output


def test_a_missing_twin_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_budget(tmp_path / "none.yaml", 2)
    output = capsys.readouterr().err
    assert "none.yaml: no such file (expected a twin.yaml, or its folder)" in output
