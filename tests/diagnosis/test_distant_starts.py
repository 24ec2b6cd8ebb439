"""A model whose servos are fifty times as stiff as the real ones."""

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

STIFFER, BRAKED = 50.0, 8.0


def vendor(folder: Path, stiffer: float, braked: float, **hidden: float) -> Path:
    """Recordings of the pendulums beside a model with other gains."""
    case(folder, **hidden)
    text = mjcf().replace(f'kp="{KP}" kv="{KV}"', f'kp="{KP * stiffer}" kv="{KV * braked}"')
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


def test_gains_far_off_are_tried_at_all_joints_and_at_each(tmp_path: Path) -> None:
    problem, whole = problem_of(vendor(tmp_path, STIFFER, BRAKED))
    together, rubbing, *alone = distant(problem, EMPTY, whole)
    gains = tuple(Term("controller_gain", j) for j in range(len(JOINTS)))
    assert together.terms == gains
    assert rubbing.terms == (*gains, *(Term("coulomb_friction", t.joint) for t in gains))
    assert [h.terms for h in alone] == [(t,) for t in gains]
    share = 1.0 + together.theta[::2]
    assert np.all((share > 0.5 / STIFFER) & (share < 3.0 / STIFFER))


def test_nothing_is_tried_where_no_servo_is_soft(tmp_path: Path) -> None:
    problem, whole = problem_of(vendor(tmp_path, 1.0, 1.0, viscous=0.3))
    assert whole.max() > (10.0 * problem.floor.max()) ** 2, "something is far off"
    assert distant(problem, EMPTY, whole) == []
    assert distant(problem, EMPTY, problem.floor**2) == []


def test_steps_of_a_fit_are_of_the_logarithm_of_a_stiffness() -> None:
    law = Term("controller_gain", 0)
    soft = Hypothesis((law,), np.array([-0.98, -0.5]))
    assert soft.from_coordinates(soft.coordinates) == pytest.approx(soft.theta)
    halved = soft.from_coordinates(soft.coordinates + np.array([np.log(0.5), 0.0]))
    assert halved == pytest.approx([-0.99, -0.5])


def test_servos_fifty_times_too_stiff_are_named_with_their_gains(tmp_path: Path) -> None:
    realization, trials = read(vendor(tmp_path, STIFFER, BRAKED))
    found = diagnose(realization, trials, threads=1)
    assert found.verdict == "explained"
    assert {(f.effect, f.joint) for f in found.explained.findings} == {
        ("controller_gain", joint) for joint in JOINTS
    }
    for finding in found.explained.findings:
        stiffness, damping = (finding.parameters[n] for n in ("stiffness_error", "damping_error"))
        assert 1.0 + stiffness.value == pytest.approx(1.0 / STIFFER, rel=5e-3)
        assert 1.0 + damping.value == pytest.approx(1.0 / BRAKED, rel=0.05)
        assert stiffness.high - stiffness.low < 0.1 / STIFFER
