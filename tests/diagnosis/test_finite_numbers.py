"""No number of a diagnosis is NaN or infinite, which JSON cannot represent."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from two_pendulums import mjcf, record

from pytest_twin.diagnosis.findings import build_estimate, build_explanation, finding_json
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.search.pruning import prune
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Parameter
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import load_model
from pytest_twin.trial import make_trial

PARAMETERS = [p for e in catalogue().values() for p in e.parameters]
RECIPROCAL = [p for p in PARAMETERS if p.reciprocal_of is not None]


def test_the_catalogue_has_at_least_three_parameters_that_are_reported_as_reciprocals() -> None:
    assert len(RECIPROCAL) >= 3


@given(
    p=st.sampled_from(PARAMETERS),
    at=st.floats(0.0, 1.0),
    half=st.floats(0.0, 1e6) | st.just(math.nan) | st.just(math.inf),
    scale=st.floats(1e-6, 1e6),
)
@settings(max_examples=300, deadline=None)
def test_an_estimate_is_finite_and_inside_its_interval(
    p: Parameter, at: float, half: float, scale: float
) -> None:
    theta = p.lower + at * (p.upper - p.lower)
    found = build_estimate(p, theta, half, scale, "1")
    json.dumps([found.value, found.low, found.high], allow_nan=False)
    slack = 1e-9 * max(abs(found.low), abs(found.high))
    assert found.low - slack <= found.value <= found.high + slack


@pytest.mark.parametrize("p", RECIPROCAL, ids=lambda p: p.name)
def test_the_reciprocal_of_zero_is_reported_as_a_large_finite_value(p: Parameter) -> None:
    scale = 0.5
    nearest = 1.0 / (p.upper * scale)
    found = build_estimate(p, 0.0, 0.0, scale, "1")
    assert found.value > 1e5 * nearest
    # An interval around zero gives a lower bound of the reciprocal.
    bounded = build_estimate(p, 0.0, 0.1 * p.upper, scale, "1")
    assert bounded.low == pytest.approx(10.0 * nearest)
    assert bounded.low < bounded.value < bounded.high


def test_a_reciprocal_away_from_zero_has_the_reciprocal_interval() -> None:
    p = RECIPROCAL[0]
    theta = 0.5 * p.upper
    found = build_estimate(p, theta, 0.1 * theta, 2.0, "1")
    assert found.value == pytest.approx(1.0 / (2.0 * theta))
    assert (found.low, found.high) == pytest.approx(
        (1.0 / (2.2 * theta), 1.0 / (1.8 * theta)), rel=1e-9
    )


def test_an_effect_that_makes_the_prediction_diverge_is_rejected_and_the_others_are_kept(
    tmp_path: Path,
) -> None:
    (tmp_path / "model.xml").write_text(mjcf())
    realization = load_model(tmp_path / "model.xml").realization
    trials = [
        make_trial(read_recording(path), realization.structure)
        for path in (
            record(tmp_path / "fit.mcap", 1, seconds=1.2, delay=0.02),
            record(tmp_path / "check.mcap", 2, seconds=1.2, delay=0.02),
        )
    ]
    prepared = prepare(realization, trials[:1], trials[1:], threads=1)
    problem = prepared.problem
    delay, drag = Term("command_delay", 0), Term("quadratic_drag", 1)
    chosen = Hypothesis((delay, drag), np.array([0.02, -200.0]))

    def scored(hypothesis: Hypothesis) -> ScoredModel:
        fit, held = (problem.residuals([hypothesis], s)[0] for s in (problem.fit, problem.held_out))
        return ScoredModel(
            FittedModel(hypothesis, fit, np.zeros((*fit.shape, hypothesis.theta.size)), 1.0),
            held,
            problem,
        )

    best = scored(chosen)
    assert not np.isfinite(best.held_residual).all()
    selected = SelectedModel(best, scored(EMPTY), confidence={delay: math.nan, drag: math.nan})
    found = build_explanation(prepared, selected, prune(prepared.problem, selected), trials)
    assert [(f.effect, f.joint) for f in found.findings] == [("command_delay", "left")]
    (finding,) = found.findings
    assert finding.parameters["delay"].value == pytest.approx(0.02, rel=0.05)
    assert finding.confidence == 0.0
    written = json.loads(json.dumps(finding_json(finding), allow_nan=False))
    assert written["held_out_gain"] > 0.9
    assert any("quadratic_drag at right" in n and "diverges" in n for n in found.notes)
