"""An algebraic solver with a smaller held-out error is named, and given if it is beyond chance."""

from __future__ import annotations

import numpy as np

from pytest_twin.calibration.solver_comparison import better_solver


def test_a_smaller_error_within_chance_keeps_the_least_squares_and_says_why() -> None:
    rng = np.random.default_rng(0)
    ours = np.abs(rng.normal(8.5e-4, 2e-4, 10))
    theirs = ours + rng.normal(0.0, 1.5e-4, 10)
    found = better_solver({"tsai": theirs - (theirs - ours).mean() - 2e-5, "least_squares": ours})
    assert found is not None
    assert (found.name, found.is_beyond_chance) == ("tsai", False)
    assert "within chance: least squares" in found.words


def test_a_smaller_error_beyond_chance_is_said_with_the_transforms_to_use() -> None:
    rng = np.random.default_rng(1)
    ours = np.abs(rng.normal(2e-3, 2e-4, 20))
    found = better_solver({"tsai": 0.5 * ours, "park": 1.1 * ours, "least_squares": ours})
    assert found is not None
    assert (found.name, found.is_beyond_chance) == ("tsai", True)
    assert "20 of 20 observations are nearer with it, which is beyond chance" in found.words
    assert "solvers.tsai has its transforms" in found.words


def test_the_errors_in_words_are_those_of_the_result() -> None:
    """Root mean square of a coordinate, and not of a distance."""
    ours = np.full(20, np.sqrt(3.0) * 1e-3)
    found = better_solver({"tsai": 0.5 * ours, "least_squares": ours})
    assert found is not None
    assert "0.5 against 1 mm" in found.words


def test_nothing_is_said_if_the_least_squares_has_the_smallest_error() -> None:
    ours = np.full(10, 1e-3)
    assert better_solver({"tsai": 2.0 * ours, "least_squares": ours}) is None
    assert better_solver({"tsai": ours, "least_squares": ours}) is None
    assert better_solver({"least_squares": np.zeros(0)}) is None
