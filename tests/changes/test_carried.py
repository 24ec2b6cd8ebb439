"""Uncertainty of the earlier model in the intervals of changes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from pytest_twin.changes.carried import _within_bounds, carried_half_widths
from pytest_twin.diagnosis.findings import Explanation
from pytest_twin.diagnosis.intervals import ParameterUncertainty
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.formats.mcap import TOPICS
from pytest_twin.loaded_model import load_model

sys.path.append(str(Path(__file__).parents[1] / "diagnosis"))
from two_pendulums import KV, case, mjcf


def known(hypothesis: Hypothesis, deviation: float) -> Explanation:
    size = hypothesis.theta.size
    covariance = deviation**2 * np.eye(size)
    uncertainty = ParameterUncertainty(
        np.full(size, 2.0 * deviation), np.eye(size), covariance, 2.0, covariance
    )
    return Explanation((), hypothesis, uncertainty=uncertainty)


def problem_of_servos_with_hardly_any_damping(folder: Path) -> Problem:
    case(folder)
    (folder / "model.xml").write_text(mjcf().replace(f'kv="{KV}"', 'kv="1e-9"'))
    realization = load_model(folder / "model.xml").realization
    trials = read_trials(sorted(folder.glob("*.mcap")), [], TOPICS, realization.structure)
    return prepare(realization, trials.fit, trials.held_out, threads=1).problem


def test_a_change_without_slope_leaves_the_intervals_of_others_finite(tmp_path: Path) -> None:
    """The damping of a servo that has hardly any changes no motion."""
    problem = problem_of_servos_with_hardly_any_damping(tmp_path)
    gain, friction = Term("controller_gain", 0), Term("viscous_friction", 0)
    changes = EMPTY.with_term(gain, np.array([-0.2, 0.0]))
    carried = [
        carried_half_widths(
            problem, changes, problem, known(EMPTY.with_term(friction, np.array([0.1])), deviation)
        )[gain]
        for deviation in (0.01, 0.02)
    ]
    assert carried[0]["damping_error"] < 1e-9
    assert carried[0]["stiffness_error"] > 0.0
    np.testing.assert_allclose(carried[1]["stiffness_error"], 2.0 * carried[0]["stiffness_error"])


def test_an_undetermined_parameter_is_as_uncertain_as_its_bounds() -> None:
    covariance = np.array([[0.04, 0.01, np.nan], [0.01, 9.0, np.nan], [np.nan, np.nan, np.inf]])
    inside = _within_bounds(covariance, np.array([1.0, 1.5, 2.0]))
    np.testing.assert_allclose(np.sqrt(np.diag(inside)), [0.2, 1.5, 2.0])
    np.testing.assert_allclose(inside[0], [0.04, 0.005, 0.0])
