"""The paired comparison of two models: how often it claims a gain that is none, and one that is."""

from __future__ import annotations

import numpy as np
from scipy import signal

from pytest_twin.identification.paired import paired

LENGTHS = (400, 600)


def correlated(random: np.random.Generator) -> np.ndarray:
    """(1000, 2) errors that are correlated over about ten samples."""
    return signal.lfilter([0.1], [1.0, -0.9], random.standard_normal((1000, 2)), axis=0)


def test_models_that_predict_alike_seldom_differ() -> None:
    random = np.random.default_rng(0)
    claimed = [
        paired(correlated(random), correlated(random), LENGTHS).is_significant for _ in range(300)
    ]
    assert np.mean(claimed) < 0.09


def test_a_gain_below_the_noise_of_either_error_is_found() -> None:
    random = np.random.default_rng(1)
    noise = correlated(random)
    bias = 0.5 * noise.std() * np.sin(np.arange(1000) / 20.0)[:, None]
    assert paired(noise + bias, noise, LENGTHS).is_significant
    assert not paired(noise, noise + bias, LENGTHS).is_significant


def test_a_model_that_diverges_is_worse() -> None:
    error = np.ones((1000, 2))
    assert paired(np.full_like(error, np.nan), error, LENGTHS).is_significant
    assert not paired(error, np.full_like(error, np.inf), LENGTHS).is_significant
