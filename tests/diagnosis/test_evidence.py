"""Gaussian and Laplace likelihoods of residuals, and the part that all windows support."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import laplace, norm

from pytest_twin.estimation.score import (
    consistent_evidence_bound,
    laplace_log_likelihood,
    log_likelihood,
)

FLOOR, MANY = np.array([1e-9]), np.array([4000.0])


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_each_likelihood_is_that_of_its_distribution_at_the_best_scale(scale: float) -> None:
    """Up to a constant per sample: log(2 pi e) / 2 for Gaussian, log(2 e) for Laplace."""
    n = int(MANY[0])
    residual = np.random.default_rng(0).laplace(0.0, scale, (n, 1))
    width, deviation = np.sqrt(np.mean(residual**2)), np.mean(np.abs(residual))
    gaussian = norm.logpdf(residual, 0.0, width).sum() + 0.5 * n * np.log(2.0 * np.pi * np.e)
    of_laplace = laplace.logpdf(residual, 0.0, deviation).sum() + n * np.log(2.0 * np.e)
    assert log_likelihood(residual, FLOOR, MANY) == pytest.approx(gaussian, rel=1e-9)
    assert laplace_log_likelihood(residual, FLOOR, MANY) == pytest.approx(of_laplace, rel=1e-9)


def test_one_short_large_deviation_decides_the_gaussian_but_not_the_laplace_likelihood() -> None:
    constant = np.full((1000, 1), 2.0)
    better = constant.copy()
    better /= 2.0
    better[:20] = 25.0
    assert log_likelihood(better, FLOOR, MANY) < log_likelihood(constant, FLOOR, MANY)
    assert laplace_log_likelihood(better, FLOOR, MANY) > laplace_log_likelihood(
        constant, FLOOR, MANY
    )


def test_residuals_below_the_noise_floor_have_equal_likelihoods() -> None:
    """Noise of 95 % and of 10 % of the floor: neither is better explained."""
    noise = np.random.default_rng(1).normal(0.0, 1.0, (4000, 1))
    for likelihood in (log_likelihood, laplace_log_likelihood):
        at_floor = likelihood(0.95 * noise, np.array([1.0]), MANY)
        assert likelihood(0.1 * noise, np.array([1.0]), MANY) == at_floor
        assert likelihood(2.0 * noise, np.array([1.0]), MANY) < at_floor - 1000.0
        assert likelihood(noise * np.nan, np.array([1.0]), MANY) == -np.inf


def test_a_gain_in_every_window_supports_the_whole_likelihood_ratio() -> None:
    """One of two models is exact, and they differ by 30 % of the noise in every window."""
    windows, samples = 400, 20
    noise = np.random.default_rng(1).standard_normal((windows * samples, 1))
    difference = 0.3 * np.sin(np.arange(windows * samples))[:, None]
    gained = 0.5 * float(np.sum((noise + difference) ** 2 - noise**2))
    supported = consistent_evidence_bound(
        noise, noise + difference, [samples] * windows, np.ones(1)
    )
    assert supported == pytest.approx(gained, rel=0.25)
    assert supported > 100.0


def test_a_gain_in_few_windows_and_a_loss_in_others_supports_no_likelihood_ratio() -> None:
    windows, samples = 70, 50
    one = np.random.default_rng(2).standard_normal((windows, samples, 1))
    other = one.copy()
    one[:3] += 3.0
    other[3:8] += 3.3
    gained = 0.5 * float(np.sum(other**2 - one**2))
    lengths = [samples] * windows
    supported = consistent_evidence_bound(
        one.reshape(-1, 1), other.reshape(-1, 1), lengths, np.ones(1)
    )
    assert gained > 200.0
    assert supported < 5.0
