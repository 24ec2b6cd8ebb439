"""The one search over recordings of a pendulum, through diagnose()."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from two_pendulums import mjcf, record

from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.loaded_model import load_model
from pytest_twin.trial import Trial


def with_sign(trial: Trial, sign: float) -> Trial:
    """A trial whose encoder counts in the other direction where ``sign`` is -1."""
    velocity = None if trial.velocity is None else sign * trial.velocity
    return replace(trial, position=sign * trial.position, velocity=velocity)


def diagnosed(folder: Path, run: Run, sign: float = 1.0, **hidden: float) -> Diagnosis:
    model = folder / "model.xml"
    model.write_text(mjcf(("left",)))
    loaded = load_model(model)
    paths = [
        record(folder / f"{seed}.mcap", seed, joints=("left",), role=role, seconds=2.2, **hidden)
        for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out"))
    ]
    trials = read_trials(paths, [], loaded.topics, loaded.realization.structure)
    trials = replace(
        trials,
        fit=tuple(with_sign(t, sign) for t in trials.fit),
        held_out=tuple(with_sign(t, sign) for t in trials.held_out),
    )
    return diagnose(loaded.realization, trials, threads=1, run=run)


@pytest.mark.parametrize(
    ("hidden", "effects", "verdict", "most_simulations"),
    [
        ({"viscous": 0.03}, {"viscous_friction"}, "explained", 150),
        ({"viscous": 0.03, "delay": 0.02}, {"viscous_friction", "command_delay"}, "explained", 300),
        ({}, set(), "no_mismatch", 50),
    ],
    ids=["one effect", "two effects", "no effect"],
)
def test_exactly_the_hidden_effects_are_named(
    tmp_path: Path,
    hidden: dict[str, float],
    effects: set[str],
    verdict: str,
    most_simulations: float,
) -> None:
    run = Run()
    found = diagnosed(tmp_path, run, **hidden)
    assert {f.effect for f in found.explanation.findings} == effects
    assert found.verdict == verdict
    for finding in found.explanation.findings:
        # A command delay and a sensor delay of one joint predict the same.
        assert finding.confidence > (0.45 if finding.effect == "command_delay" else 0.9)
    assert not found.skipped_searches
    assert run.budget.work < most_simulations


def test_a_reversed_sign_of_the_encoder_is_a_scale_error_of_minus_two(tmp_path: Path) -> None:
    found = diagnosed(tmp_path, Run(), sign=-1.0)
    (finding,) = found.explanation.findings
    assert finding.effect == "encoder_scale"
    assert finding.parameters["scale_error"].value == pytest.approx(-2.0, abs=0.01)
    assert found.verdict == "explained"
