"""Command ``pytest-twin randomize``: written files, exit status and error messages."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from in_process import InProcess
from ranges_files import MEANS, covariance, make_twin, record, record_motion, true_arm

from pytest_twin import cli
from pytest_twin.commands import child_result
from pytest_twin.formats.recordings import read_one
from pytest_twin.formats.schema import load_schema


@pytest.fixture(autouse=True)
def in_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run without a child process to save time, except in one test."""
    if request.function is not test_final_recordings_in_the_folder_are_found_and_checked:
        monkeypatch.setattr(child_result, "Sandbox", InProcess)


def run_randomize(twin: Path, status: int, *words: str) -> Path:
    out = twin.parent / "out"
    assert cli.main(["randomize", str(twin), "--out", str(out), *words]) == status
    return out


def record_final(twin: Path, values: np.ndarray, name: str = "final.mcap", **changes: Any) -> Path:
    folder = twin.parent / "recordings"
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(3)
    return record_motion(folder / name, true_arm(values), rng, seconds=2.0, **changes)


def test_final_recordings_in_the_folder_are_found_and_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    record_final(twin, np.random.default_rng(1).multivariate_normal(MEANS, covariance()))
    out = run_randomize(twin, 0, "--draws", "64")
    document = json.loads((out / "ranges.json").read_text())
    jsonschema.validate(document, load_schema("results/randomize.schema.json"))
    assert document["check"]["recordings"] == ["final.mcap"]
    output = capsys.readouterr().out
    assert "the final recordings lie in the predicted envelope" in output
    assert "elbow: coverage " in output


def test_without_final_recordings_the_verdict_is_not_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = run_randomize(make_twin(tmp_path, [record(covariance())]), 1)
    assert json.loads((out / "ranges.json").read_text())["verdict"] == "not_checked"
    assert "to do: record motions of the task that no fit or choice uses" in capsys.readouterr().out


def test_a_robot_outside_the_ranges_fails_the_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    record_final(twin, MEANS, bias=2.0)
    run_randomize(twin, 1, "--draws", "64")
    assert "the final recordings leave the predicted envelope" in capsys.readouterr().out


def test_ranges_much_wider_than_the_observed_deviations_fail_the_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    record_final(twin, MEANS)
    run_randomize(twin, 1, "--draws", "128")
    assert "wider than the final recordings need" in capsys.readouterr().out


def error_line(twin: Path, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    run_randomize(twin, 2, *words)
    (output,) = capsys.readouterr().err.strip().splitlines()
    assert not (twin.parent / "out").exists()
    return output


def test_a_twin_without_records_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = error_line(make_twin(tmp_path, []), capsys)
    assert (
        "fit: no record states an uncertainty of this twin (expected identification.json" in output
    )


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([-1e-3] + [1e-4] * 7), "its covariance has a negative eigenvalue"),
        (np.ones((8, 8)) + np.triu(np.ones((8, 8)), 1), "its covariance is not symmetric"),
        (np.full((8, 8), np.nan), "not JSON"),
        (np.zeros((8, 8)), "nothing of this twin's records varies: their covariances are zero"),
        (np.zeros((7, 8)), "covariance: not 8 rows"),
    ],
)
def test_an_invalid_covariance_is_refused(
    tmp_path: Path, matrix: np.ndarray, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    one = record(covariance())
    one["covariance"]["matrix"] = matrix.tolist()
    assert words in error_line(make_twin(tmp_path, [one]), capsys)


def test_a_record_without_covariance_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = record(covariance())
    one["covariance"] = {"names": [], "matrix": []}
    output = error_line(make_twin(tmp_path, [one]), capsys)
    assert "covariance: it has no covariance (expected a record of pytest-twin identify" in output


def test_a_singular_covariance_is_accepted(tmp_path: Path) -> None:
    direction = np.sqrt(np.diag(covariance()))
    out = run_randomize(make_twin(tmp_path, [record(np.outer(direction, direction))]), 1)
    document = json.loads((out / "ranges.json").read_text())
    assert np.linalg.matrix_rank(np.array(document["correlation"]), tol=1e-9) == 1


def test_a_final_recording_used_by_a_record_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    path = record_final(twin, MEANS)
    from pytest_twin.formats.digest import file_sha256

    used = {"fit_7.mcap": {"sha256": file_sha256(path)}}
    make_twin(tmp_path, [record(covariance(), inputs=used)])
    output = error_line(twin, capsys)
    assert f"{path}: a final recording that was used before: 'fitted' was made from it" in output


def test_a_recording_of_another_role_is_not_final(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    path = record_final(twin, MEANS, role="fit")
    output = error_line(twin, capsys, "--final", str(path))
    assert "role: its own metadata give it another role than 'final' (got 'fit'" in output


def test_more_robots_than_fit_in_memory_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    record_final(twin, MEANS)
    output = error_line(twin, capsys, "--draws", "100000000")
    assert "draws: the traces of so many robots do not fit in memory" in output


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--draws", "0", "'0': expected a whole number of at least 32 robots"),
        ("--draws", "1e3", "'1e3': expected a whole number of at least 32 robots"),
        ("--share", "95", "got '95', expected a fraction between 0.5 and 1, such as 0.95"),
        ("--share", "most", "got 'most', expected a fraction between 0.5 and 1, such as 0.95"),
    ],
)
def test_a_number_that_cannot_be_used_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, value: str, words: str
) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    with pytest.raises(SystemExit) as ended:
        cli.main(["randomize", str(twin), option, value, "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert words in capsys.readouterr().err


def test_a_held_out_recording_given_by_the_final_option_counts_as_final(tmp_path: Path) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    path = record_final(twin, MEANS, role="held_out").rename(tmp_path / "named.mcap")
    out = run_randomize(twin, 0, "--final", str(path), "--draws", "64")
    notes = json.loads((out / "ranges.json").read_text())["notes"]
    assert any(note.startswith("named.mcap counts as final, as it is named") for note in notes)


def test_a_recording_given_as_final_and_held_out_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    path = str(record_final(twin, MEANS, role="held_out"))
    output = error_line(twin, capsys, "--final", path, "--held-out", path)
    assert "it is held out too, and may widen the ranges" in output


@pytest.mark.parametrize("kept", [1.0, 0.6])
def test_a_final_recording_that_is_a_copy_in_another_format_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kept: float
) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    path = record_final(twin, MEANS, role="held_out")
    series = read_one(path).series
    state, command = series["state"], series["command"]
    rows = round(kept * len(state.stamp))
    copy = tmp_path / "copy.csv"
    names = [f"{name}.{field}" for field in ("position", "command") for name in state.names]
    values = np.column_stack(
        [state.position, np.stack([
            np.interp(state.stamp, command.stamp, column) for column in command.position.T
        ], axis=1)]
    )  # fmt: skip
    lines = [
        ",".join([str(stamp), *(f"{value:.6f}" for value in row)])
        for stamp, row in zip(state.stamp[:rows], values[:rows], strict=True)
    ]
    copy.write_text("\n".join([",".join(["time", *names]), *lines]) + "\n")
    output = error_line(twin, capsys, "--final", str(copy))
    assert "its measured motion is that of final.mcap; it is held out too" in output


def test_another_run_of_the_same_motion_is_no_copy(tmp_path: Path) -> None:
    twin = make_twin(tmp_path, [record(covariance())])
    trials = [
        record_motion(
            tmp_path / f"{name}.mcap", true_arm(MEANS), np.random.default_rng(3), 2.0, role, bias
        )
        for name, role, bias in (("a", "final", 0.0), ("b", "held_out", 0.05))
    ]
    words = ["--final", str(trials[0]), "--held-out", str(trials[1]), "--draws", "64"]
    assert cli.main(["randomize", str(twin), "--out", str(tmp_path / "out"), *words]) != 2
