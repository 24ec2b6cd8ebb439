"""Confidence intervals for correlated errors of successive observations."""

from __future__ import annotations

from dataclasses import replace

import cells
import numpy as np
import pytest

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.estimation.covariance import block_jackknife

TRUTH = np.array([0.7, -0.3])


def contains_truth(rng: np.random.Generator, memory: float) -> tuple[np.ndarray, np.ndarray]:
    """Whether the intervals of two linear coefficients contain the truth, with and without blocks.

    Args:
        rng: generator of the inputs and errors.
        memory: correlation of successive errors.
    """
    count = 200
    slopes = np.stack([np.ones(count), np.cumsum(rng.normal(size=count)) / 10.0], axis=1)
    errors = np.zeros(count)
    for at in range(1, count):
        errors[at] = memory * errors[at - 1] + rng.normal()
    found = np.linalg.lstsq(slopes, slopes @ TRUTH + errors, rcond=None)[0]
    residuals = slopes @ (found - TRUTH) - errors
    covariance, quantile = block_jackknife(slopes[:, None, :], residuals[:, None], np.zeros((2, 2)))
    alone = np.linalg.inv(slopes.T @ slopes) * np.sum(residuals**2) / (count - 2)
    off = np.abs(found - TRUTH)
    in_blocks = off <= quantile * np.sqrt(np.diag(covariance))
    return in_blocks, off <= 1.97 * np.sqrt(np.diag(alone))


@pytest.mark.parametrize(("memory", "least", "most_alone"), [(0.0, 0.93, 1.0), (0.8, 0.88, 0.7)])
def test_block_intervals_contain_the_truth_for_correlated_errors(
    memory: float, least: float, most_alone: float
) -> None:
    rng = np.random.default_rng(0)
    drawn = np.array([contains_truth(rng, memory) for _ in range(400)])
    in_blocks, alone = drawn.mean(axis=(0, 2))
    assert least <= in_blocks <= 0.995
    assert alone <= most_alone


def test_the_interval_of_a_scale_grows_with_the_correlation_of_the_errors() -> None:
    """The same errors in correlated and in random order; correlated ones give wider intervals."""
    rng = np.random.default_rng(1)
    count = 64
    drift = np.repeat(rng.normal(0.0, 4e-3, (8, 3)), 8, axis=0)
    widths = {}
    for name, order in (("shared", np.arange(count)), ("shuffled", rng.permutation(count))):
        draw = np.random.default_rng(2)
        # Successive poses are similar: eight poses about each of eight places.
        flange = np.repeat([cells.pose(draw, 0.3) for _ in range(8)], 8, axis=0)
        flange[:, :3, 3] += draw.normal(0.0, 0.02, (count, 3))
        cell = cells.flange_cell(draw, flange, translation=2e-4, rotation=2e-4)
        poses = cell.observations.camera_from_target.copy()
        poses[:, :3, 3] = 0.5 * (poses[:, :3, 3] + drift[order])
        observations = replace(cell.observations, camera_from_target=poses)
        plan = cells.plan("hand_eye", camera={"scale": "estimate"})
        low, high = calibrate(plan, observations, None)["records"]["scale"]["ci95"]
        widths[name] = high - low
    assert widths["shared"] > 1.5 * widths["shuffled"]
