"""Recordings of servos with 2 % of the stiffness of the model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from searched import named
from two_pendulums import JOINTS, KP, KV, case, mjcf

from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.equation_error import distant_gains
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.simplification import special_cases
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.formats.mcap import TOPICS
from pytest_twin.loaded_model import load_model
from pytest_twin.realization import Realization

STIFFER, MORE_DAMPED = 50.0, 8.0


def case_with_wrong_gains(
    folder: Path, stiffer: float, more_damped: float, **hidden: float
) -> Path:
    """Write recordings of the pendulums, and a model whose servo gains have these factors."""
    case(folder, **hidden)
    text = mjcf().replace(f'kp="{KP}" kv="{KV}"', f'kp="{KP * stiffer}" kv="{KV * more_damped}"')
    (folder / "model.xml").write_text(text)
    return folder


def read(folder: Path) -> tuple[Realization, TrialSet]:
    realization = load_model(folder / "model.xml").realization
    recordings = sorted(folder.glob("*.mcap"))
    return realization, read_trials(recordings, [], TOPICS, realization.structure)


def problem_of(folder: Path) -> Problem:
    realization, trials = read(folder)
    return prepare(realization, trials.fit, trials.held_out, threads=1).problem


def test_the_equation_error_is_near_gains_that_are_far_from_the_models(tmp_path: Path) -> None:
    start = distant_gains(problem_of(case_with_wrong_gains(tmp_path, STIFFER, MORE_DAMPED)))
    for joint in range(len(JOINTS)):
        gains = start.theta[start.slice_of(Term("controller_gain", joint))]
        assert 0.3 < STIFFER * (1.0 + gains[0]) < 3.0


@pytest.mark.parametrize(
    ("stiffer", "hidden"),
    [(1.0, {"viscous": 0.3}), (1.0, {"dry": 0.2}), (1.5, {}), (0.7, {"dry": 0.2})],
    ids=["viscous friction", "dry friction", "stiffer", "softer, with dry friction"],
)
def test_gains_that_derivatives_lead_to_have_no_start(
    tmp_path: Path, stiffer: float, hidden: dict[str, float]
) -> None:
    problem = problem_of(case_with_wrong_gains(tmp_path, stiffer, 1.0, **hidden))
    assert not distant_gains(problem).terms


def test_a_torque_constant_is_no_special_case_of_a_gain_that_it_cannot_have(
    tmp_path: Path,
) -> None:
    problem = problem_of(case_with_wrong_gains(tmp_path, STIFFER, MORE_DAMPED))
    term = Term("controller_gain", 0)
    near, far = (
        special_cases(problem, EMPTY.with_term(term, np.array([error, -0.5])))
        for error in (-0.5, -0.98)
    )
    assert {t.effect for h in near for t in h.terms} == {"torque_constant"}
    assert not far


def test_right_servo_gains_are_not_named_beside_another_effect(tmp_path: Path) -> None:
    problem = problem_of(case_with_wrong_gains(tmp_path, 1.0, 1.0, viscous=0.3))
    assert {t.effect for t in named(problem).terms} == {"viscous_friction"}


def test_a_fit_varies_the_logarithm_of_the_servo_stiffness() -> None:
    law = Term("controller_gain", 0)
    soft = Hypothesis((law,), np.array([-0.98, -0.5]))
    assert soft.from_coordinates(soft.coordinates) == pytest.approx(soft.theta)
    halved = soft.from_coordinates(soft.coordinates + np.array([np.log(0.5), 0.0]))
    assert halved == pytest.approx([-0.99, -0.5])


def test_servo_stiffness_of_two_percent_of_the_models_value_is_found(tmp_path: Path) -> None:
    realization, trials = read(case_with_wrong_gains(tmp_path, STIFFER, MORE_DAMPED))
    found = diagnose(realization, trials, threads=1)
    assert found.verdict == "explained"
    assert {(f.effect, f.joint) for f in found.explanation.findings} == {
        ("controller_gain", joint) for joint in JOINTS
    }
    for finding in found.explanation.findings:
        stiffness, damping = (finding.parameters[n] for n in ("stiffness_error", "damping_error"))
        assert 1.0 + stiffness.value == pytest.approx(1.0 / STIFFER, rel=5e-3)
        assert 1.0 + damping.value == pytest.approx(1.0 / MORE_DAMPED, rel=0.05)
        assert stiffness.high - stiffness.low < 0.1 / STIFFER


def test_a_delay_that_looks_like_a_soft_servo_is_named(tmp_path: Path) -> None:
    """Along the motion of 1.2 s, a delay of 0.1 s takes up most of the command's error."""
    folder = case_with_wrong_gains(tmp_path, 1.0, 1.0, delay=0.1)
    assert {t.effect for t in distant_gains(problem_of(folder)).terms} == {"controller_gain"}
    found = diagnose(*read(folder), threads=1)
    assert [f.effect for f in found.explanation.findings] == ["command_delay"]
    assert found.explanation.findings[0].parameters["delay"].value == pytest.approx(0.1, rel=0.01)
