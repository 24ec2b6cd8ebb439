"""The one search over recordings of a pendulum, through diagnose()."""

from __future__ import annotations

from pathlib import Path

import pytest
from two_pendulums import mjcf, record

from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.one_search.structure import find_structure
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.loaded_model import load_model


def diagnosed(folder: Path, run: Run, **hidden: float) -> Diagnosis:
    model = folder / "model.xml"
    model.write_text(mjcf(("left",)))
    loaded = load_model(model)
    paths = [
        record(folder / f"{seed}.mcap", seed, joints=("left",), role=role, seconds=2.2, **hidden)
        for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out"))
    ]
    trials = read_trials(paths, [], loaded.topics, loaded.realization.structure)
    return diagnose(loaded.realization, trials, threads=1, run=run, find=find_structure)


@pytest.mark.parametrize(
    ("hidden", "effects", "verdict"),
    [
        ({"viscous": 0.03}, {"viscous_friction"}, "explained"),
        ({"viscous": 0.03, "delay": 0.02}, {"viscous_friction", "command_delay"}, "explained"),
        ({}, set(), "no_mismatch"),
    ],
    ids=["one effect", "two effects", "no effect"],
)
def test_exactly_the_hidden_effects_are_named(
    tmp_path: Path, hidden: dict[str, float], effects: set[str], verdict: str
) -> None:
    run = Run()
    found = diagnosed(tmp_path, run, **hidden)
    assert {f.effect for f in found.explanation.findings} == effects
    assert found.verdict == verdict
    for finding in found.explanation.findings:
        # A command delay and a sensor delay of one joint predict the same.
        assert finding.confidence > (0.45 if finding.effect == "command_delay" else 0.9)
    assert run.budget.work < 300
    assert not found.skipped_searches
