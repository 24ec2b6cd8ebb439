"""At any moment of a run, its limit gives a valid result that claims no more than was tried."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from estimating_commands import INPUTS, Estimating

from pytest_twin import cli, time_limit
from pytest_twin.formats.schema import load_schema

pytestmark = pytest.mark.usefixtures("commands_in_process")
NOISE = 1e-4
"""Of the recorded positions of the identified pendulum, rad."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Estimating]:
    return {
        name: INPUTS[name](tmp_path_factory.mktemp(name))
        for name in ("identify", "randomize", "excite", "budget")
    }


def run_limited(
    command: Estimating, out: Path, readings: int, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Any]:
    """Run a command whose clock advances by 1 s at each reading, and return its result."""
    clock = itertools.count(1).__next__
    monkeypatch.setattr(time_limit, "processor_seconds", clock)
    monkeypatch.setattr(time_limit, "call_began", lambda: 0)
    status = cli.main([*command.words, "--seconds", str(readings), "--out", str(out)])
    document: dict[str, Any] = json.loads((out / command.result).read_text())
    jsonschema.validate(document, load_schema(f"results/{command.words[0]}.schema.json"))
    assert status in (0, 1)
    return document


@pytest.mark.parametrize(
    ("name", "readings"),
    [(name, readings) for name in ("identify", "randomize", "excite", "budget")
     for readings in (0.5, 2, 9)],
)  # fmt: skip
def test_a_limited_run_lists_what_it_did_not_try_and_claims_nothing_about_it(
    inputs: dict[str, Estimating],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    readings: float,
) -> None:
    command = inputs[name]
    document = run_limited(command, tmp_path / "out", readings, monkeypatch)
    if document["not_tried"]:
        assert document["verdict"] != command.complete
    elif readings < 1:
        pytest.fail("nothing can be complete before the first step")
    assert not (tmp_path / "out" / "trajectories").exists() or document["trajectories"]


def test_an_identification_keeps_the_stages_that_it_finished(
    inputs: dict[str, Estimating], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = []
    for readings in (1, 300):
        out = tmp_path / str(readings)
        document = run_limited(inputs["identify"], out, readings, monkeypatch)
        errors.append(document["held_out"]["swing"]["position_rms"])
        tried = {stage["stage"] for stage in document["stages"]}
        assert not any(f"stage {name}" in document["not_tried"] for name in tried)
        assert (out / "realization" / "model.xml").is_file()
    assert errors[1] < 0.9 * errors[0]


@pytest.mark.nightly
def test_a_longer_limit_never_gives_a_worse_identification(
    inputs: dict[str, Estimating], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The searches of two limits take the same steps; the longer one goes on."""
    held_out = []
    for readings in (5, 40, 150, 600):
        document = run_limited(inputs["identify"], tmp_path / str(readings), readings, monkeypatch)
        held_out.append(document["held_out"]["swing"])
    for before, after in itertools.pairwise(held_out):
        assert after["position_rms"] <= max(before["position_rms"], 2.0 * after["noise_floor"])
    # The search ends with the step and the friction of the simulation that made the recordings.
    assert held_out[-1]["position_rms"] < 1.1 * NOISE


def test_ranges_are_checked_with_the_robots_that_were_simulated(
    inputs: dict[str, Estimating], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots = []
    for readings in (0.5, 1, 6):
        document = run_limited(inputs["randomize"], tmp_path / str(readings), readings, monkeypatch)
        robots.append(document["throughput"]["robots"])
        # Only with robots in all final recordings are the ranges called useful.
        assert (document["verdict"] == "useful") is (readings == 6)
    assert robots == [0, 64, 128]
