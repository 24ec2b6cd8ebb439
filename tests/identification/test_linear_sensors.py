"""Intervals of linear sensors: their coverage, and the degrees of freedom of their variances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t as student

from pytest_twin.sensors.linear import BLOCKS, fit_linear, in_blocks


def motion(rng: np.random.Generator, count: int, channels: int) -> np.ndarray:
    """Slow signals, so that a few blocks of time have most of the excitation."""
    time = np.arange(count) * 0.025
    found = np.zeros((count, channels))
    for channel in range(channels):
        for _ in range(4):
            rate, phase = rng.uniform(0.05, 0.5), rng.uniform(0.0, 6.0)
            found[:, channel] += rng.normal() * np.sin(2.0 * np.pi * rate * time + phase)
    return found


def test_intervals_hold_the_true_values_at_the_stated_share() -> None:
    """A sandwich covariance of block sums with 29 degrees of freedom holds 91 % of them."""
    rng = np.random.default_rng(0)
    inside: list[bool] = []
    for _ in range(150):
        true = motion(rng, 600, 4)
        matrix, bias = np.eye(4) + 0.03 * rng.normal(size=(4, 4)), rng.normal(size=4)
        noise = rng.normal(size=(600 + 4, 4))
        # Smoothing correlates the noise of neighbouring samples.
        smooth = sum(noise[k : k + 600] for k in range(5)) / 5.0
        reading = true @ matrix.T + bias + 0.05 * smooth
        found = fit_linear(true, reading, in_blocks([300, 300]), np.eye(4))
        quantile = student.ppf(0.975, found.freedom)
        for channel in range(4):
            half = quantile * np.sqrt(np.diag(found.covariance[channel]))
            estimate = np.append(found.matrix[channel], found.bias[channel])
            wrong = np.abs(estimate - np.append(matrix[channel], bias[channel]))
            inside += (wrong <= half).tolist()
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def test_equally_excited_blocks_have_one_degree_of_freedom_less_than_blocks() -> None:
    true = np.tile([1.0, -1.0], 30 * BLOCKS)[:, None]
    rng = np.random.default_rng(1)
    reading = true + rng.normal(size=true.shape)
    found = fit_linear(true, reading, in_blocks([len(true)]), np.eye(1))
    assert found.freedom == pytest.approx([BLOCKS - 1, BLOCKS - 1], rel=1e-6)
    # Then the variance is that of independent noise.
    expected = 1.0 / len(true)
    assert found.covariance[0, 0, 0] == pytest.approx(expected, rel=0.6)


def test_a_parameter_that_one_block_determines_has_few_degrees_of_freedom() -> None:
    rng = np.random.default_rng(2)
    true = 0.01 * rng.normal(size=(1200, 1))
    true[:40] *= 100.0
    reading = true + rng.normal(size=true.shape)
    found = fit_linear(true, reading, in_blocks([len(true)]), np.eye(1))
    assert found.freedom[0] < 3.0
    assert found.freedom[1] > 20.0
