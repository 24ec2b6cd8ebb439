"""Confidence intervals contain the true value as often as stated, with correlated residuals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from pytest_twin.diagnosis.intervals import clusters, jackknife, parameter_uncertainty
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.segment import Predicted
from pytest_twin.estimation.hypothesis import Hypothesis, Scales, Term
from pytest_twin.estimation.least_squares import FittedModel
from pytest_twin.estimation.score import effective_samples

SAMPLES, SEGMENTS = 600, 3
TRUTH = np.array([1.0, -0.5])


def problem(discretization_error: np.ndarray | None = None, recordings: int = 1) -> Problem:
    """The part of a problem that intervals depend on: stamps, floors and discretization error."""
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


def least_squares(
    rng: np.random.Generator, correlation: float, similarity: float = 0.0
) -> FittedModel:
    """Least squares of two regressors under first-order autoregressive noise."""
    n = SAMPLES * SEGMENTS
    t = np.arange(n) * 0.01
    one = np.sin(2.1 * t + rng.uniform(0, 6))
    two = similarity * one + np.sqrt(1 - similarity**2) * np.sin(3.7 * t + rng.uniform(0, 6))
    design = np.stack([one, two], axis=1)
    white = rng.standard_normal(n) * np.sqrt(1 - correlation**2)
    y = design @ TRUTH + 0.1 * lfilter([1.0], [1.0, -correlation], white)
    theta = np.linalg.lstsq(design, y, rcond=None)[0]
    residual = (y - design @ theta)[:, None]
    return FittedModel(Hypothesis((), theta), residual, design[:, None, :], 0.0)


def coverage(correlation: float, similarity: float = 0.0) -> float:
    inside = []
    for seed in range(150):
        found = least_squares(np.random.default_rng(seed), correlation, similarity)
        width = parameter_uncertainty(problem(), found).half_width
        inside.append(np.abs(found.hypothesis.theta - TRUTH) <= width)
    return float(np.mean(inside))


def test_95_percent_intervals_contain_the_truth_in_90_to_99_percent_of_cases() -> None:
    for correlation in (0.0, 0.8, 0.95):
        assert 0.9 <= coverage(correlation) <= 0.99, correlation


def test_intervals_widen_with_autocorrelation_and_follow_the_textbook_for_white_noise() -> None:
    rng = np.random.default_rng(3)
    white = parameter_uncertainty(problem(), least_squares(rng, 0.0)).half_width
    red = parameter_uncertainty(problem(), least_squares(rng, 0.95)).half_width
    assert (red > 2.0 * white).all()
    # Amplitude of a sine in white noise of standard deviation 0.1: 1.96 * 0.1 sqrt(2 / n).
    assert np.allclose(white, 1.96 * 0.1 * np.sqrt(2.0 / (SAMPLES * SEGMENTS)), rtol=0.5)


def test_recordings_that_disagree_widen_the_interval() -> None:
    inside = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        found = least_squares(rng, 0.0)
        # Each recording has its own parameters around the true ones, as with an inexact law.
        design = found.jacobian[:, 0]
        own = np.repeat(0.05 * rng.standard_normal((SEGMENTS, 2)), SAMPLES, axis=0)
        y = design @ found.hypothesis.theta + found.residual[:, 0] + (design * own).sum(axis=1)
        theta = np.linalg.lstsq(design, y, rcond=None)[0]
        refitted = FittedModel(
            Hypothesis((), theta), (y - design @ theta)[:, None], found.jacobian, 0.0
        )
        width = parameter_uncertainty(problem(recordings=SEGMENTS), refitted).half_width
        inside.append(np.abs(theta - TRUTH) <= width)
    assert 0.9 <= float(np.mean(inside)) <= 0.99


def test_intervals_of_correlated_parameters_contain_the_truth() -> None:
    found = parameter_uncertainty(
        problem(), least_squares(np.random.default_rng(0), 0.8, similarity=0.995)
    )
    assert found.correlation[0, 1] < -0.95
    assert coverage(0.8, similarity=0.995) >= 0.9


def test_the_interval_of_a_parameter_without_influence_is_wide() -> None:
    """A limit that the drive does not reach."""
    seen = least_squares(np.random.default_rng(2), 0.8)
    unreached = np.zeros((SAMPLES * SEGMENTS, 1, 1))
    whole = replace(
        seen,
        hypothesis=Hypothesis((), np.append(seen.hypothesis.theta, 0.3)),
        jacobian=np.concatenate([seen.jacobian, unreached], axis=2),
    )
    for recordings in (1, SEGMENTS):
        alone = parameter_uncertainty(problem(recordings=recordings), seen).half_width
        half = parameter_uncertainty(problem(recordings=recordings), whole).half_width
        assert half[:2] == pytest.approx(alone, rel=0.02)
        assert half[2] > 1e6


def test_the_interval_includes_the_uncertainty_of_the_discretization_error() -> None:
    given = least_squares(np.random.default_rng(1), 0.0)
    without = parameter_uncertainty(problem(), given).half_width
    error = 0.4 * given.jacobian[:, :, 0]
    with_it = parameter_uncertainty(problem(error), given).half_width
    # An eighth of a discretization error of 0.4 times the response to the first parameter.
    assert np.isclose(with_it[0] - without[0], 0.05, rtol=0.1)
    assert with_it[1] - without[1] < 0.01


def _with_model_error(
    seed: int, recordings: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Design, residual, estimate and recording of each sample.

    Each recording has its own smooth error, as of an inexact law, and correlated noise.
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


def test_jackknife_intervals_contain_the_truth_if_model_errors_differ_between_recordings() -> None:
    white_noise, jackknifed = [], []
    for seed in range(400):
        design, residual, theta, owner = _with_model_error(seed, recordings=5)
        information = design.T @ design
        effective = effective_samples(residual[:, None], [400] * 5)
        variance = np.mean(residual**2) * len(residual) / effective
        half = 1.96 * np.sqrt(np.diag(np.linalg.inv(information)) * variance)
        white_noise.append(np.abs(theta - TRUTH) <= half)
        parts = [design[owner == k] for k in range(5)]
        scores = np.array([d.T @ residual[owner == k] for k, d in enumerate(parts)])
        wide = np.sqrt(np.diag(jackknife(scores, np.array([d.T @ d for d in parts]))))
        jackknifed.append(np.abs(theta - TRUTH) <= wide)
    assert float(np.mean(white_noise)) < 0.9
    assert 0.9 <= float(np.mean(jackknifed)) <= 0.99


def test_few_recordings_are_divided_into_more_clusters() -> None:
    assert np.array_equal(np.unique(clusters([0, 1, 2], [5, 5, 5])), [0, 1, 2])
    two = clusters([0, 0, 1], [30, 30, 60])
    assert len(np.unique(two)) == 6
    assert (np.diff(two) >= 0).all()


def test_alternative_models_with_other_values_widen_the_interval() -> None:
    given = least_squares(np.random.default_rng(2), 0.0)
    term = Term("controller_gain", 0)
    one = FittedModel(
        Hypothesis((term,), given.hypothesis.theta), given.residual, given.jacobian, 0.0
    )
    alone = parameter_uncertainty(problem(), one).half_width
    with_alternative = parameter_uncertainty(
        problem(), one, [(1.0, {term: np.array([0.4, 0.0])})]
    ).half_width
    # The alternative is as likely as the best model and 0.4 away: standard deviation sqrt(0.5) 0.4.
    assert with_alternative[0] == pytest.approx(
        np.hypot(alone[0], 1.96 * 0.4 * np.sqrt(0.5)), rel=0.02
    )
    assert with_alternative[1] == pytest.approx(alone[1])
