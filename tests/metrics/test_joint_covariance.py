"""Combination of covariances of several estimates."""

from __future__ import annotations

import numpy as np

from pytest_twin.metrics.joint_covariance import upper_covariance, with_deviations


def drawn(random: np.random.Generator, rank: int) -> np.ndarray:
    root = random.standard_normal((4, rank)) * [[1e-3], [1.0], [20.0], [0.1]]
    return root @ root.T


def test_the_combined_covariance_is_not_smaller_in_any_direction() -> None:
    random = np.random.default_rng(0)
    for rank in (4, 4, 2, 1):
        first, second = drawn(random, 4), drawn(random, rank)
        found = upper_covariance(first, second)
        for one in (first, second):
            size = np.sqrt(np.diag(found))
            left = (found - one) / np.outer(size, size)
            assert np.linalg.eigvalsh(left).min() > -1e-9


def test_of_two_proportional_covariances_the_larger_is_returned() -> None:
    first = drawn(np.random.default_rng(1), 4)
    np.testing.assert_allclose(upper_covariance(first, 9.0 * first), 9.0 * first)
    np.testing.assert_allclose(upper_covariance(first, 0.1 * first), first)
    np.testing.assert_allclose(upper_covariance(first, np.zeros((4, 4))), first)


def test_variation_between_recordings_is_kept_along_a_precise_direction() -> None:
    """Two parameters vary by 0.1 between recordings; the noise covariance of their sum is small."""
    noise = 0.01 * np.array([[1.0, -0.99], [-0.99, 1.0]])
    between = 0.01 * np.eye(2)
    found = upper_covariance(noise, between)
    along = np.array([1.0, 1.0])
    assert along @ noise @ along < 0.00021
    assert along @ found @ along > 0.0199


def test_a_covariance_is_scaled_up_to_given_standard_deviations() -> None:
    covariance = np.array([[4.0, -1.8], [-1.8, 1.0]])
    found = with_deviations(covariance, np.array([1.0, 2.0]))
    np.testing.assert_allclose(np.diag(found), [1.0, 4.0])
    np.testing.assert_allclose(found[0, 1], -0.9)
    np.testing.assert_allclose(with_deviations(covariance, np.array([2.0, 1.0])), covariance)
