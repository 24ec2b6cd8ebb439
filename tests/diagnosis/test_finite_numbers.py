"""No number of a diagnosis is NaN or infinite: JSON has neither, and a reader can use neither."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from two_pendulums import mjcf, record

from pytest_twin.commands.replay import load_model
from pytest_twin.diagnosis.findings import estimate, explain, finding_json
from pytest_twin.diagnosis.fit import Fitted
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.search.pruning import prune
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Parameter
from pytest_twin.formats.mcap import read_recording
from pytest_twin.trial import make_trial

PARAMETERS = [p for e in catalogue().values() for p in e.parameters]
RECIPROCAL = [p for p in PARAMETERS if p.reciprocal_of is not None]


def test_the_catalogue_has_laws_that_are_absent_at_infinity() -> None:
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
    found = estimate(p, theta, half, scale, "1")
    json.dumps([found.value, found.low, found.high], allow_nan=False)
    slack = 1e-9 * max(abs(found.low), abs(found.high))
    assert found.low - slack <= found.value <= found.high + slack


@pytest.mark.parametrize("p", RECIPROCAL, ids=lambda p: p.name)
def test_a_reciprocal_of_zero_is_said_to_be_far_off(p: Parameter) -> None:
    scale = 0.5
    nearest = 1.0 / (p.upper * scale)
    found = estimate(p, 0.0, 0.0, scale, "1")
    assert found.value > 1e5 * nearest
    # What is known is where it is not: nearer than the interval's end.
    known = estimate(p, 0.0, 0.1 * p.upper, scale, "1")
    assert known.low == pytest.approx(10.0 * nearest)
    assert known.low < known.value < known.high


def test_a_plain_reciprocal_is_one() -> None:
    p = RECIPROCAL[0]
    theta = 0.5 * p.upper
    found = estimate(p, theta, 0.1 * theta, 2.0, "1")
    assert found.value == pytest.approx(1.0 / (2.0 * theta))
    assert (found.low, found.high) == pytest.approx(
        (1.0 / (2.2 * theta), 1.0 / (1.8 * theta)), rel=1e-9
    )


def test_what_diverges_is_not_claimed_and_the_rest_is(tmp_path: Path) -> None:
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
    late, blown = Term("command_delay", 0), Term("quadratic_drag", 1)
    chosen = Hypothesis((late, blown), np.array([0.02, -200.0]))

    def rival(hypothesis: Hypothesis) -> ScoredModel:
        fit, held = (problem.residuals([hypothesis], s)[0] for s in (problem.fit, problem.held_out))
        return ScoredModel(
            Fitted(hypothesis, fit, np.zeros((*fit.shape, hypothesis.theta.size)), 1.0), held
        )

    best = rival(chosen)
    assert not np.isfinite(best.held_residual).all()
    selected = SelectedModel(best, rival(EMPTY), confidence={late: math.nan, blown: math.nan})
    found = explain(prepared, selected, prune(prepared.problem, selected), trials)
    assert [(f.effect, f.joint) for f in found.findings] == [("command_delay", "left")]
    (finding,) = found.findings
    assert finding.parameters["delay"].value == pytest.approx(0.02, rel=0.05)
    assert finding.confidence == 0.0
    said = json.loads(json.dumps(finding_json(finding), allow_nan=False))
    assert said["held_out_gain"] > 0.9
    assert any("quadratic_drag at right" in n and "diverges" in n for n in found.notes)
