"""Parameters that only rounding distinguishes have wide intervals."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.identification.effort.least_squares import LinearProblem, solve

ROWS, NOISE = 2000, 0.01


def problem_of(apart: float) -> LinearProblem:
    """Two columns that differ by a share ``apart`` of their length; their sum is 1."""
    random = np.random.default_rng(3)
    first, other = random.standard_normal((2, ROWS))
    matrix = np.stack([first, first + apart * other], axis=1)[:, None]
    effort = first[:, None] + NOISE * random.standard_normal((ROWS, 1))
    known = np.ones((ROWS, 1), dtype=bool)
    lengths = (ROWS // 4,) * 4
    return LinearProblem(matrix, effort, known, ~known, np.zeros((1, 2), dtype=bool), lengths)


@pytest.mark.parametrize("apart", [1e-2, 1e-4, 1e-6, 1e-7, 3e-8, 0.0])
def test_the_interval_of_nearly_equal_columns_contains_the_true_values(apart: float) -> None:
    found = solve(problem_of(apart))
    assert np.isfinite(found.half_width).all()
    assert (np.abs(found.values - [1.0, 0.0]) < 2.0 * found.half_width).all()
    # The deviation of least squares. Normal equations do not resolve smaller differences.
    exact = NOISE / (max(apart, 3e-8) * np.sqrt(ROWS))
    assert (found.half_width > exact).all()


def test_well_determined_columns_keep_their_exact_covariance() -> None:
    problem = problem_of(1.0)
    found = solve(problem)
    rows = problem.matrix[:, 0] * found.weight
    information = rows.T @ rows
    ratio = found.covariance @ information
    assert np.diag(ratio) == pytest.approx(np.diag(ratio).mean(), rel=0.5)
