"""Confidence intervals of the block bootstrap for correlated residuals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from pytest_twin.estimation.covariance import block_of
from pytest_twin.identification.effort.blocks import bootstrap
from pytest_twin.identification.effort.least_squares import LinearProblem, solve

TRUE = np.array([2.0, -0.7])


def linear_problem(seed: int, recordings: int, rows: int, correlated: float) -> LinearProblem:
    """One joint and two parameters; the noise has unit variance and is correlated in time."""
    random = np.random.default_rng(seed)
    count = recordings * rows
    matrix = np.stack([np.ones(count), np.sin(np.arange(count) / 7.0)], axis=1)[:, None]
    noise = signal.lfilter([1.0], [1.0, -correlated], random.standard_normal((count, 1)), axis=0)
    return LinearProblem(
        matrix, matrix @ TRUE + noise * np.sqrt(1 - correlated**2),
        np.ones((count, 1), dtype=bool), np.zeros((count, 1), dtype=bool),
        np.zeros((1, 2), dtype=bool), (rows,) * recordings,
    )  # fmt: skip


@pytest.mark.parametrize(("recordings", "rows"), [(2, 600), (15, 80)])
@pytest.mark.parametrize("correlated", [0.0, 0.8])
def test_the_95_percent_interval_contains_the_true_value_in_95_percent_of_runs(
    recordings: int, rows: int, correlated: float
) -> None:
    inside = []
    for seed in range(60):
        problem = linear_problem(seed, recordings, rows, correlated)
        low, high = bootstrap(problem, solve(problem)).interval.T
        inside.append((low <= TRUE) & (high >= TRUE))
    # For 120 intervals three standard errors are 6 %; 15 blocks make the intervals less accurate.
    assert 0.87 <= np.mean(inside) <= 0.995


def test_a_too_narrow_interval_is_reported() -> None:
    problem = linear_problem(1, 2, 600, 0.9)
    fitted = solve(problem)
    narrow = bootstrap(problem, type(fitted)(**{
        **{name: getattr(fitted, name) for name in fitted.__dataclass_fields__},
        "half_width": 0.2 * fitted.half_width,
    }))  # fmt: skip
    assert narrow.wider.all()
    assert not bootstrap(problem, fitted).wider.any()


def test_blocks_are_recordings_or_parts_of_them_if_there_are_few() -> None:
    assert len(np.unique(block_of((50,) * 12))) == 12
    assert len(np.unique(block_of((500, 500)))) == 20
