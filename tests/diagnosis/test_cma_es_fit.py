"""Where slopes lead nowhere values still do."""

from __future__ import annotations

import numpy as np
import pytest
from two_pendulums import mjcf, record

from pytest_twin.commands.replay import load_model
from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.cma_es_fit import (
    fit_by_evolution,
    initial_covariance_root,
    mean_absolute_deviations,
)
from pytest_twin.formats.mcap import read_recording
from pytest_twin.trial import make_trial

LAG = 0.05
LAGS = Term("actuator_lag", 0)


@pytest.fixture(scope="module")
def hunting(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """A pendulum whose servo lags until it swings by itself, longer and longer."""
    folder = tmp_path_factory.mktemp("hunting")
    (folder / "model.xml").write_text(mjcf(("left",)))
    realization = load_model(folder / "model.xml").realization
    file = record(folder / "1.mcap", 1, seconds=3.0, joints=("left",), lag=LAG)
    trial = make_trial(read_recording(file), realization.structure)
    return prepare(realization, [trial], [], threads=1).problem


def lagging(seconds: float, problem: Problem) -> Hypothesis:
    scale = problem.scales.value(LAGS.parameters[0], 0)
    return EMPTY.with_term(LAGS, np.array([seconds / scale, 0.0]))


def wide(start: Hypothesis) -> np.ndarray:
    """First steps that know of nothing."""
    return np.diag(0.3 * start.sizes[start.movable])


def test_a_valley_is_left_that_a_fit_by_slopes_stays_in(hunting: Problem) -> None:
    start, weights = lagging(0.09, hunting), 1.0 / hunting.signal_floor
    scale = hunting.scales.value(LAGS.parameters[0], 0)
    (stuck,) = fit(hunting, [start], weights, hunting.fit, iterations=20)
    assert abs(stuck.hypothesis.theta[0] * scale - LAG) > 0.01
    found = fit_by_evolution(hunting, [start], weights, wide(start))
    assert found.theta[0] * scale == pytest.approx(LAG, rel=0.05)
    far, near = mean_absolute_deviations(hunting, [stuck.hypothesis, found], weights)
    assert near < 0.2 * far


def test_of_several_ends_the_deepest_stands(hunting: Problem) -> None:
    weights = 1.0 / hunting.signal_floor
    scale = hunting.scales.value(LAGS.parameters[0], 0)
    # Next to nothing is found from where the servo does not swing at all.
    for order in ((0.001, 0.06), (0.06, 0.001)):
        starts = [lagging(s, hunting) for s in order]
        found = fit_by_evolution(hunting, starts, weights, wide(lagging(0.001, hunting)))
        assert found.theta[0] * scale == pytest.approx(LAG, rel=0.05)


def test_first_steps_are_long_where_windows_tell_little() -> None:
    """Two parameters whose sum alone is seen, and one that nothing sees."""
    terms = tuple(Term(e, 0) for e in ("viscous_friction", "coulomb_friction", "armature"))
    hypothesis = Hypothesis(terms, np.array([1.0, 1.0, 1.0]))
    rng = np.random.default_rng(0)
    seen = rng.standard_normal((4000, 1))
    jacobian = np.stack([seen, seen, 0.0 * seen], axis=2)
    residual, floor = 0.02 * rng.standard_normal((4000, 1)), np.array([0.001])
    steps = initial_covariance_root(Fitted(hypothesis, residual, jacobian, 0.0), floor)
    draws = steps @ rng.standard_normal((3, 20000))
    total, apart, unseen = draws[0] + draws[1], draws[0] - draws[1], draws[2]
    # Of three parameters that share half of 0.02, one is felt: 0.01 / sqrt(3).
    assert np.std(total) == pytest.approx(0.01 / np.sqrt(3.0), rel=0.05)
    assert np.std(apart) == pytest.approx(np.sqrt(2.0) * 0.15, rel=0.05)
    assert np.std(unseen) == pytest.approx(0.15, rel=0.05)


def test_values_are_taken_of_terms_that_both_have() -> None:
    friction = Term("coulomb_friction", 0)
    one = Hypothesis((Term("viscous_friction", 0), friction), np.array([1.0, 2.0]))
    other = Hypothesis((friction, Term("armature", 0)), np.array([5.0, 6.0]))
    assert np.array_equal(one.with_values_of(other).theta, [1.0, 5.0])
    assert one.with_values_of(other).terms == one.terms


def test_the_same_start_comes_to_the_same_end(hunting: Problem) -> None:
    weights = 1.0 / hunting.signal_floor
    np.random.seed(0)  # what others draw is left alone, and does not matter
    start = lagging(0.03, hunting)
    first = fit_by_evolution(hunting, [start], weights, wide(start))
    untouched = np.random.get_state()[1][0]
    np.random.random()
    assert np.array_equal(
        fit_by_evolution(hunting, [start], weights, wide(start)).theta, first.theta
    )
    assert untouched == 0


def test_what_has_nothing_to_fit_stays(hunting: Problem) -> None:
    assert fit_by_evolution(hunting, [EMPTY], 1.0 / hunting.signal_floor, np.empty((0, 0))) is EMPTY
