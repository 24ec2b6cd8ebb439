"""Intervals hold: on drawn data with correlated residuals they contain the truth as they claim."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from pytest_twin.diagnosis.evidence import effective_samples
from pytest_twin.diagnosis.fit import Fitted
from pytest_twin.diagnosis.hypothesis import Hypothesis, Scales, Term
from pytest_twin.diagnosis.intervals import clusters, jackknife, parameter_spread
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.segment import Predicted

SAMPLES, SEGMENTS = 600, 3
TRUTH = np.array([1.0, -0.5])


def problem(discretization_error: np.ndarray | None = None, recordings: int = 1) -> Problem:
    """As much of a problem as intervals read: stamps, floors, and what the time step costs."""
    segments = [
        SimpleNamespace(time=np.arange(SAMPLES) * 0.01, effort=None, trial=i % recordings)
        for i in range(SEGMENTS)
    ]
    none = np.zeros((SAMPLES, 1))
    return Problem(
        simulator=SimpleNamespace(segments=segments),  # type: ignore[arg-type]
        fit=np.arange(SEGMENTS),
        held_out=np.empty(0, int),
        floor=np.array([1e-6]),
        scales=Scales({}),
        discretization_error={}
        if discretization_error is None
        else {i: Predicted(discretization_error[i * SAMPLES : (i + 1) * SAMPLES], none, none)
              for i in range(SEGMENTS)},
    )  # fmt: skip


def fitted(rng: np.random.Generator, correlation: float, likeness: float = 0.0) -> Fitted:
    """Least squares of two regressors under first-order autoregressive noise."""
    n = SAMPLES * SEGMENTS
    t = np.arange(n) * 0.01
    one = np.sin(2.1 * t + rng.uniform(0, 6))
    two = likeness * one + np.sqrt(1 - likeness**2) * np.sin(3.7 * t + rng.uniform(0, 6))
    design = np.stack([one, two], axis=1)
    white = rng.standard_normal(n) * np.sqrt(1 - correlation**2)
    y = design @ TRUTH + 0.1 * lfilter([1.0], [1.0, -correlation], white)
    theta = np.linalg.lstsq(design, y, rcond=None)[0]
    residual = (y - design @ theta)[:, None]
    return Fitted(Hypothesis((), theta), residual, design[:, None, :], 0.0)


def coverage(correlation: float, likeness: float = 0.0) -> float:
    inside = []
    for seed in range(150):
        found = fitted(np.random.default_rng(seed), correlation, likeness)
        width = parameter_spread(problem(), found).half_width
        inside.append(np.abs(found.hypothesis.theta - TRUTH) <= width)
    return float(np.mean(inside))


def test_intervals_contain_the_truth_as_often_as_they_say() -> None:
    for correlation in (0.0, 0.8, 0.95):
        assert 0.9 <= coverage(correlation) <= 0.99, correlation


def test_intervals_widen_with_correlation_and_are_no_wider_than_needed() -> None:
    rng = np.random.default_rng(3)
    white = parameter_spread(problem(), fitted(rng, 0.0)).half_width
    red = parameter_spread(problem(), fitted(rng, 0.95)).half_width
    assert (red > 2.0 * white).all()
    # White noise of deviation 0.1 on a sine: 0.1 sqrt(2 / n) and Student's 1.96.
    assert np.allclose(white, 1.96 * 0.1 * np.sqrt(2.0 / (SAMPLES * SEGMENTS)), rtol=0.5)


def test_recordings_that_disagree_widen_the_interval() -> None:
    inside = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        found = fitted(rng, 0.0)
        # Every recording has parameters of its own around the truth: a law that is not quite right.
        design = found.jacobian[:, 0]
        own = np.repeat(0.05 * rng.standard_normal((SEGMENTS, 2)), SAMPLES, axis=0)
        y = design @ found.hypothesis.theta + found.residual[:, 0] + (design * own).sum(axis=1)
        theta = np.linalg.lstsq(design, y, rcond=None)[0]
        again = Fitted(Hypothesis((), theta), (y - design @ theta)[:, None], found.jacobian, 0.0)
        width = parameter_spread(problem(recordings=SEGMENTS), again).half_width
        inside.append(np.abs(theta - TRUTH) <= width)
    assert 0.9 <= float(np.mean(inside)) <= 0.99


def test_parameters_that_trade_off_are_known_in_combination() -> None:
    found = parameter_spread(problem(), fitted(np.random.default_rng(0), 0.8, likeness=0.995))
    assert found.correlation[0, 1] < -0.95
    assert coverage(0.8, likeness=0.995) >= 0.9


def test_what_the_time_step_leaves_is_in_the_interval() -> None:
    given = fitted(np.random.default_rng(1), 0.0)
    without = parameter_spread(problem(), given).half_width
    pull = 0.4 * given.jacobian[:, :, 0]
    with_it = parameter_spread(problem(pull), given).half_width
    # An eighth of a defect that looks like the first parameter's response, 0.4 of it.
    assert np.isclose(with_it[0] - without[0], 0.05, rtol=0.1)
    assert with_it[1] - without[1] < 0.01


def _with_model_error(
    seed: int, recordings: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Design, residual, estimate and recording of each sample: every recording is off by a smooth
    error of its own, as of a law that is not quite right, and by correlated noise.
    """
    rng = np.random.default_rng(seed)
    n, designs, measured = 400, [], []
    t = np.arange(n) * 0.01
    for _ in range(recordings):
        one, two = (np.sin(w * t + rng.uniform(0, 6)) for w in rng.uniform(1.5, 4.5, 2))
        own = 0.2 * rng.standard_normal(2)
        noise = lfilter([1.0], [1.0, -0.9], 0.05 * rng.standard_normal(n))
        designs.append(np.stack([one, two], axis=1))
        measured.append(designs[-1] @ (TRUTH + own) + noise)
    design, y = np.concatenate(designs), np.concatenate(measured)
    theta = np.linalg.lstsq(design, y, rcond=None)[0]
    return design, y - design @ theta, theta, np.repeat(np.arange(recordings), n)


def test_intervals_hold_where_the_model_is_wrong_in_another_way_in_each_recording() -> None:
    plain, widened = [], []
    for seed in range(400):
        design, residual, theta, owner = _with_model_error(seed, recordings=5)
        information = design.T @ design
        effective = effective_samples(residual[:, None], [400] * 5)
        variance = np.mean(residual**2) * len(residual) / effective
        half = 1.96 * np.sqrt(np.diag(np.linalg.inv(information)) * variance)
        plain.append(np.abs(theta - TRUTH) <= half)
        parts = [design[owner == k] for k in range(5)]
        scores = np.array([d.T @ residual[owner == k] for k, d in enumerate(parts)])
        wide = np.sqrt(np.diag(jackknife(scores, np.array([d.T @ d for d in parts]))))
        widened.append(np.abs(theta - TRUTH) <= wide)
    assert float(np.mean(plain)) < 0.9
    assert 0.9 <= float(np.mean(widened)) <= 0.99


def test_few_recordings_are_cut_into_parts() -> None:
    assert np.array_equal(np.unique(clusters([0, 1, 2], [5, 5, 5])), [0, 1, 2])
    two = clusters([0, 0, 1], [30, 30, 60])
    assert len(np.unique(two)) == 6
    assert (np.diff(two) >= 0).all()


def test_parameters_that_near_structures_move_are_less_well_known() -> None:
    given = fitted(np.random.default_rng(2), 0.0)
    term = Term("controller_gain", 0)
    one = Fitted(Hypothesis((term,), given.hypothesis.theta), given.residual, given.jacobian, 0.0)
    alone = parameter_spread(problem(), one).half_width
    near = parameter_spread(problem(), one, [(1.0, {term: np.array([0.4, 0.0])})]).half_width
    # As likely as the best, 0.4 away: a deviation of sqrt(0.5) 0.4.
    assert near[0] == pytest.approx(np.hypot(alone[0], 1.96 * 0.4 * np.sqrt(0.5)), rel=0.02)
    assert near[1] == pytest.approx(alone[1])
