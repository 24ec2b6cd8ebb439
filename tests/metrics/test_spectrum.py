"""Spectral densities by Welch's method."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import csd, welch

from pytest_twin.metrics.spectrum import cross_density, power_density

RATE = 200.0


@pytest.mark.parametrize("size", [8, 63, 64])
@pytest.mark.parametrize("padded", [64, 129])
@pytest.mark.parametrize("centred", [True, False])
def test_the_power_density_equals_that_of_scipy(size: int, padded: int, centred: bool) -> None:
    values = 3.0 + np.random.default_rng(size).standard_normal(500)
    frequency, power = power_density(values, RATE, size, padded=padded, centred=centred)
    expected = welch(
        values, RATE, nperseg=size, nfft=padded, detrend="constant" if centred else False
    )
    np.testing.assert_allclose(frequency, expected[0])
    np.testing.assert_allclose(power, expected[1], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("size", [8, 63, 64])
def test_the_cross_density_equals_that_of_scipy(size: int) -> None:
    first, second = 3.0 + np.random.default_rng(size).standard_normal((2, 500))
    frequency, found = cross_density(first, second, RATE, size)
    expected = csd(first, second, RATE, nperseg=size)
    np.testing.assert_allclose(frequency, expected[0])
    np.testing.assert_allclose(found, expected[1], rtol=1e-9, atol=1e-15)


def test_the_integral_of_the_power_is_the_mean_square() -> None:
    values = 2.0 * np.sin(2.0 * np.pi * 10.0 * np.arange(4000) / RATE)
    frequency, power = power_density(values, RATE, 400)
    assert power.sum() * frequency[1] == pytest.approx(np.mean(values**2), rel=1e-6)
    assert frequency[np.argmax(power)] == pytest.approx(10.0)
