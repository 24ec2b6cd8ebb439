"""Which effects carry a name: the three rules, and the order of the findings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from two_pendulums import mjcf, record

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.findings import build_explanation
from pytest_twin.diagnosis.intervals import ParameterUncertainty
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.search.model import Model
from pytest_twin.diagnosis.search.posterior import NamedModel, Posterior
from pytest_twin.diagnosis.search.report_rules import absent_together, contains_absence, rejections
from pytest_twin.estimation.comparison import Size
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import fit
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import load_model
from pytest_twin.trial import make_trial

DRAG = Term("viscous_friction", 0)


def fitted(hypothesis: Hypothesis, jacobian: FloatArray, level: float = 0.0) -> Model:
    """A model with a constant residual."""
    residual = np.full(jacobian.shape[:2], level)
    size = Size(len(hypothesis.terms), hypothesis.theta.size)
    return Model(hypothesis, residual, size, "test", hypothesis, 0.0, jacobian)


def interval(half_width: float) -> ParameterUncertainty:
    """The uncertainty of one parameter."""
    return ParameterUncertainty(np.array([half_width]), np.eye(1), np.eye(1), 2.0, np.eye(1))


@pytest.mark.parametrize(
    ("remaining", "without", "half_width", "is_impossible", "reason"),
    [
        pytest.param(1.0, 20.0, 0.01, False, None, id="known and explains all"),
        pytest.param(1.0, 2.0, 2.0, False, "contains its absence", id="may be absent"),
        pytest.param(1.0, 20.0, 2.0, False, None, id="its removal shows that it is needed"),
        pytest.param(15.0, 20.0, 0.01, False, "closest known effect", id="much remains"),
        pytest.param(1.0, 20.0, 0.01, True, "below zero", id="impossible total"),
    ],
)
def test_an_effect_carries_a_name_if_it_is_possible_present_and_explains_its_mismatch(
    remaining: float, without: float, half_width: float, is_impossible: bool, reason: str | None
) -> None:
    """Errors are in noise floors; the nominal model is at 20."""
    model = fitted(EMPTY.with_term(DRAG, np.array([1.0])), np.ones((4, 1, 1)), remaining)
    nominal = fitted(EMPTY, np.zeros((4, 1, 0)), 20.0)
    refused = {DRAG: "its total would be below zero"} if is_impossible else {}
    physics: Any = SimpleNamespace(
        floor=np.ones(1), joints=["left"], given=(), refusals=lambda hypothesis: refused
    )
    found = rejections(
        model, nominal, {DRAG: np.array([without**2])}, interval(half_width), physics
    )
    why = {**found.wrong, **found.absent}
    assert set(why) == (set() if reason is None else {DRAG})
    if reason is not None:
        assert reason in why[DRAG]


@pytest.mark.parametrize(("slope", "absent"), [(1.0, True), (0.0, False)], ids=["gradient", "none"])
def test_an_effect_without_gradient_is_not_considered_absent(slope: float, absent: bool) -> None:
    """The finite difference of a time-out between two samples is zero."""
    term = Term("watchdog_timeout", 0)
    hypothesis = EMPTY.with_term(term, np.array([50.0, 0.05]))
    jacobian = np.ones((4, 1, 2)) * [slope, 1.0]
    model = fitted(hypothesis, jacobian)
    known = ParameterUncertainty(np.array([1e6, 1e-3]), np.eye(2), np.eye(2), 2.0, np.eye(2))
    assert contains_absence(model, term, known) is absent


@pytest.mark.parametrize(
    ("correlation_of_both", "absent"),
    [
        pytest.param(0.0, True, id="each alone may be zero"),
        pytest.param(-0.95, False, id="the sum is known and not zero"),
        pytest.param(0.95, True, id="the difference is known and zero"),
    ],
)
def test_correlated_parameters_are_tested_together_for_absence(
    correlation_of_both: float, absent: bool
) -> None:
    """Static and sliding friction are uncertain alone, but their sum may be certain."""
    term = Term("motor_load_friction", 0)
    hypothesis = EMPTY.with_term(term, np.array([0.1, 0.1, 0.5]))
    model = fitted(hypothesis, np.ones((4, 1, 3)))
    correlation = np.eye(3)
    correlation[0, 1] = correlation[1, 0] = correlation_of_both
    known = ParameterUncertainty(
        np.array([0.12, 0.12, 1.0]), correlation, np.eye(3), 2.0, np.eye(3)
    )
    assert contains_absence(model, term, known) is absent


def test_the_joint_confidence_region_contains_95_percent_of_normal_samples() -> None:
    """The samples are of a correlated normal distribution."""
    random = np.random.default_rng(3)
    correlation = np.array([[1.0, -0.8], [-0.8, 1.0]])
    known = ParameterUncertainty(np.full(2, 1.96), correlation, correlation, 1.96, correlation)
    draws = random.multivariate_normal(np.zeros(2), correlation, 2000)
    inside = np.mean([known.normalized_distance(np.arange(2), d) <= 1.0 for d in draws])
    assert inside == pytest.approx(0.95, abs=0.015)


def test_findings_are_sorted_by_the_change_of_the_prediction_without_them(tmp_path: Path) -> None:
    """Friction changes the prediction most, but the delay is the first effect of the hypothesis."""
    (tmp_path / "model.xml").write_text(mjcf())
    realization = load_model(tmp_path / "model.xml").realization
    trials = [
        make_trial(
            read_recording(
                record(tmp_path / f"{seed}.mcap", seed, seconds=1.2, viscous=0.6, delay=0.002)
            ),
            realization.structure,
        )
        for seed in (1, 2)
    ]
    prepared = prepare(realization, trials[:1], trials[1:], threads=1)
    problem = prepared.problem
    terms = (Term("command_delay", 0), DRAG)
    hypothesis = EMPTY
    for term, value in zip(terms, (0.002, 0.6), strict=True):
        scale = problem.scales.value(term.parameters[0], 0)
        hypothesis = hypothesis.with_term(term, np.array([value / scale]))
    problem = problem.at(hypothesis)
    weights = 1.0 / problem.signal_floor
    (best,) = fit(problem, [hypothesis], weights, problem.fit, iterations=12)
    reduced = [best.hypothesis.without(t) for t in terms]
    named = NamedModel(best, reduced, Posterior(confidence=dict.fromkeys(terms, 1.0)))
    found = build_explanation(prepared, named, trials).findings
    assert [f.effect for f in found] == ["viscous_friction", "command_delay"]
    assert found[0].influence > 2.0 * found[1].influence > 0.0


def test_of_two_effects_with_one_cause_only_one_may_be_absent() -> None:
    """The damping of the joint and of its servo: their sum is known, neither of them alone."""
    servo = Term("controller_gain", 0)
    hypothesis = EMPTY.with_term(DRAG, np.array([0.5])).with_term(servo, np.array([0.0, 0.5]))
    random = np.random.default_rng(2)
    motion, stiffness = random.standard_normal((2, 400, 1))
    model = fitted(hypothesis, np.stack([motion, stiffness, motion], axis=2), 1.0)
    known = ParameterUncertainty(np.array([9.0, 0.1, 9.0]), np.eye(3), np.eye(3), 2.0, np.eye(3))
    assert absent_together(model, [DRAG, servo], known, np.ones(1)) == [DRAG]
    without_cause = replace(model, hypothesis=hypothesis.with_theta(np.array([0.5, 0.0, -0.5])))
    assert absent_together(without_cause, [DRAG, servo], known, np.ones(1)) == [DRAG, servo]
