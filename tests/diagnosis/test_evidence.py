"""Likelihoods of what is left: of squares, and of absolute deviations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import laplace, norm

from pytest_twin.diagnosis.evidence import (
    laplace_log_likelihood,
    log_likelihood,
    supported_by_windows,
)

FLOOR, MANY = np.array([1e-9]), np.array([4000.0])


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_likelihoods_are_those_of_their_distributions_at_the_best_scale(scale: float) -> None:
    """Up to what is the same of any residual: half a log of 2 pi e, and log 2 e, a sample."""
    n = int(MANY[0])
    left = np.random.default_rng(0).laplace(0.0, scale, (n, 1))
    width, deviation = np.sqrt(np.mean(left**2)), np.mean(np.abs(left))
    gaussian = norm.logpdf(left, 0.0, width).sum() + 0.5 * n * np.log(2.0 * np.pi * np.e)
    of_laplace = laplace.logpdf(left, 0.0, deviation).sum() + n * np.log(2.0 * np.e)
    assert log_likelihood(left, FLOOR, MANY) == pytest.approx(gaussian, rel=1e-9)
    assert laplace_log_likelihood(left, FLOOR, MANY) == pytest.approx(of_laplace, rel=1e-9)


def test_one_slide_that_ends_elsewhere_is_most_of_a_square_and_little_of_a_deviation() -> None:
    followed = np.full((1000, 1), 2.0)
    better = followed.copy()
    better /= 2.0
    better[:20] = 25.0
    assert log_likelihood(better, FLOOR, MANY) < log_likelihood(followed, FLOOR, MANY)
    assert laplace_log_likelihood(better, FLOOR, MANY) > laplace_log_likelihood(
        followed, FLOOR, MANY
    )


def test_what_is_noise_earns_nothing_by_either() -> None:
    """Noise as large as the floor, or a tenth of it: neither explains more than the other."""
    noise = np.random.default_rng(1).normal(0.0, 1.0, (4000, 1))
    for likelihood in (log_likelihood, laplace_log_likelihood):
        at_floor = likelihood(0.95 * noise, np.array([1.0]), MANY)
        assert likelihood(0.1 * noise, np.array([1.0]), MANY) == at_floor
        assert likelihood(2.0 * noise, np.array([1.0]), MANY) < at_floor - 1000.0
        assert likelihood(noise * np.nan, np.array([1.0]), MANY) == -np.inf


def test_what_every_window_gains_is_borne_out_as_likelihoods_have_it() -> None:
    """Of two laws of which one is right, apart by a part of the noise everywhere."""
    windows, long = 400, 20
    noise = np.random.default_rng(1).standard_normal((windows * long, 1))
    apart = 0.3 * np.sin(np.arange(windows * long))[:, None]
    gained = 0.5 * float(np.sum((noise + apart) ** 2 - noise**2))
    most = supported_by_windows(noise, noise + apart, [long] * windows, np.ones(1))
    assert most == pytest.approx(gained, rel=0.25)
    assert most > 100.0


def test_what_a_few_windows_gain_and_others_lose_is_not_borne_out() -> None:
    windows, long = 70, 50
    one = np.random.default_rng(2).standard_normal((windows, long, 1))
    other = one.copy()
    one[:3] += 3.0
    other[3:8] += 3.3
    gained = 0.5 * float(np.sum(other**2 - one**2))
    lengths = [long] * windows
    most = supported_by_windows(one.reshape(-1, 1), other.reshape(-1, 1), lengths, np.ones(1))
    assert gained > 200.0
    assert most < 5.0
