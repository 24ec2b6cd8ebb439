"""Rates of false and true detections of the paired comparison of two models."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from pytest_twin.estimation.paired_test import PairedTest, compare_paired

LENGTHS = (400, 600)


def correlated_errors(random: np.random.Generator) -> np.ndarray:
    """Errors (1000, 2) that are correlated over about ten samples."""
    return signal.lfilter([0.1], [1.0, -0.9], random.standard_normal((1000, 2)), axis=0)


def test_equally_good_models_seldom_differ_significantly() -> None:
    random = np.random.default_rng(0)
    claimed = [
        compare_paired(correlated_errors(random), correlated_errors(random), LENGTHS).is_significant
        for _ in range(300)
    ]
    assert np.mean(claimed) < 0.09


def test_an_improvement_smaller_than_the_noise_is_detected() -> None:
    random = np.random.default_rng(1)
    noise = correlated_errors(random)
    bias = 0.5 * noise.std() * np.sin(np.arange(1000) / 20.0)[:, None]
    assert compare_paired(noise + bias, noise, LENGTHS).is_significant
    assert not compare_paired(noise, noise + bias, LENGTHS).is_significant


def test_a_reduction_is_significant_by_its_standard_error_or_if_the_error_halves() -> None:
    assert PairedTest(1.0, 0.5, 0.1).is_significant
    assert not PairedTest(1.0, 0.9, 0.7).is_significant
    # A single event has as large a standard error as its mean.
    assert PairedTest(1.0, 0.9, 0.8).is_significant
    error = correlated_errors(np.random.default_rng(2))
    assert compare_paired(error, 0.4 * error, LENGTHS).share == pytest.approx(0.84)


def test_a_diverging_model_is_significantly_worse() -> None:
    error = np.ones((1000, 2))
    assert compare_paired(np.full_like(error, np.nan), error, LENGTHS).is_significant
    assert not compare_paired(error, np.full_like(error, np.inf), LENGTHS).is_significant
