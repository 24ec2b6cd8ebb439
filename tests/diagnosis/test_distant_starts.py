"""Recordings of servos with 2 % of the stiffness of the model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from two_pendulums import JOINTS, KP, KV, case, mjcf

from pytest_twin.commands.replay import load_model
from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.distant_starts import distant
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.formats.mcap import TOPICS
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


def problem_of(folder: Path) -> tuple[Problem, np.ndarray]:
    realization, trials = read(folder)
    problem = prepare(realization, trials.fit, trials.held_out, threads=1).problem
    (left,) = problem.residuals([EMPTY], problem.fit)
    return problem, np.mean(left**2, axis=0)


def test_distant_servo_gains_are_tried_at_all_joints_together_and_at_each_alone(
    tmp_path: Path,
) -> None:
    problem, nominal = problem_of(case_with_wrong_gains(tmp_path, STIFFER, MORE_DAMPED))
    together, with_friction, *alone = distant(problem, EMPTY, nominal)
    gains = tuple(Term("controller_gain", j) for j in range(len(JOINTS)))
    assert together.terms == gains
    assert with_friction.terms == (*gains, *(Term("coulomb_friction", t.joint) for t in gains))
    assert [h.terms for h in alone] == [(t,) for t in gains]
    share = 1.0 + together.theta[::2]
    assert np.all((share > 0.5 / STIFFER) & (share < 3.0 / STIFFER))


def test_no_distant_start_is_tried_with_the_right_servo_gains(tmp_path: Path) -> None:
    problem, nominal = problem_of(case_with_wrong_gains(tmp_path, 1.0, 1.0, viscous=0.3))
    assert nominal.max() > (10.0 * problem.floor.max()) ** 2, "the nominal error must be large"
    assert distant(problem, EMPTY, nominal) == []
    assert distant(problem, EMPTY, problem.floor**2) == []


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
    assert {(f.effect, f.joint) for f in found.explained.findings} == {
        ("controller_gain", joint) for joint in JOINTS
    }
    for finding in found.explained.findings:
        stiffness, damping = (finding.parameters[n] for n in ("stiffness_error", "damping_error"))
        assert 1.0 + stiffness.value == pytest.approx(1.0 / STIFFER, rel=5e-3)
        assert 1.0 + damping.value == pytest.approx(1.0 / MORE_DAMPED, rel=0.05)
        assert stiffness.high - stiffness.low < 0.1 / STIFFER
