"""Covariances of several estimates in one."""

from __future__ import annotations

import numpy as np

from pytest_twin.metrics.joint_covariance import upper_covariance, with_deviations


def drawn(random: np.random.Generator, rank: int) -> np.ndarray:
    root = random.standard_normal((4, rank)) * [[1e-3], [1.0], [20.0], [0.1]]
    return root @ root.T


def test_no_direction_has_less_variance_than_in_either() -> None:
    random = np.random.default_rng(0)
    for rank in (4, 4, 2, 1):
        first, second = drawn(random, 4), drawn(random, rank)
        found = upper_covariance(first, second)
        for one in (first, second):
            size = np.sqrt(np.diag(found))
            left = (found - one) / np.outer(size, size)
            assert np.linalg.eigvalsh(left).min() > -1e-9


def test_the_wider_of_two_multiples_is_it() -> None:
    first = drawn(np.random.default_rng(1), 4)
    np.testing.assert_allclose(upper_covariance(first, 9.0 * first), 9.0 * first)
    np.testing.assert_allclose(upper_covariance(first, 0.1 * first), first)
    np.testing.assert_allclose(upper_covariance(first, np.zeros((4, 4))), first)


def test_a_sum_that_one_estimate_knows_well_is_not_taken_from_it() -> None:
    """Recordings disagree by 0.1 in each of two parameters; noise knows their sum to 0.014."""
    noise = 0.01 * np.array([[1.0, -0.99], [-0.99, 1.0]])
    between = 0.01 * np.eye(2)
    found = upper_covariance(noise, between)
    along = np.array([1.0, 1.0])
    assert along @ noise @ along < 0.00021
    assert along @ found @ along > 0.0199


def test_deviations_are_those_asked_for() -> None:
    covariance = np.array([[4.0, -1.8], [-1.8, 1.0]])
    found = with_deviations(covariance, np.array([1.0, 2.0]))
    np.testing.assert_allclose(np.diag(found), [1.0, 4.0])
    np.testing.assert_allclose(found[0, 1], -0.9)
    np.testing.assert_allclose(with_deviations(covariance, np.array([2.0, 1.0])), covariance)
