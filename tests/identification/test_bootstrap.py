"""The block bootstrap holds where residuals are correlated and where blocks differ."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from pytest_twin.identification.effort.blocks import block_of, bootstrap
from pytest_twin.identification.effort.least_squares import Linear, solve

TRUE = np.array([2.0, -0.7])


def line(seed: int, recordings: int, rows: int, correlated: float) -> Linear:
    """One joint and two parameters; noise of standard deviation 1, correlated over samples."""
    random = np.random.default_rng(seed)
    count = recordings * rows
    matrix = np.stack([np.ones(count), np.sin(np.arange(count) / 7.0)], axis=1)[:, None]
    noise = signal.lfilter([1.0], [1.0, -correlated], random.standard_normal((count, 1)), axis=0)
    return Linear(
        matrix, matrix @ TRUE + noise * np.sqrt(1 - correlated**2),
        np.ones((count, 1), dtype=bool), np.zeros((count, 1), dtype=bool),
        np.zeros((1, 2), dtype=bool), (rows,) * recordings,
    )  # fmt: skip


@pytest.mark.parametrize(("recordings", "rows"), [(2, 600), (15, 80)])
@pytest.mark.parametrize("correlated", [0.0, 0.8])
def test_the_interval_covers_the_truth(recordings: int, rows: int, correlated: float) -> None:
    inside = []
    for seed in range(60):
        problem = line(seed, recordings, rows, correlated)
        low, high = bootstrap(problem, solve(problem)).interval.T
        inside.append((low <= TRUE) & (high >= TRUE))
    # 120 intervals of 95 %: three standard errors are 6 %, and 15 blocks are few.
    assert 0.87 <= np.mean(inside) <= 0.995


def test_an_interval_that_is_too_narrow_is_named() -> None:
    problem = line(1, 2, 600, 0.9)
    fitted = solve(problem)
    narrow = bootstrap(problem, type(fitted)(**{
        **{name: getattr(fitted, name) for name in fitted.__dataclass_fields__},
        "half_width": 0.2 * fitted.half_width,
    }))  # fmt: skip
    assert narrow.wider.all()
    assert not bootstrap(problem, fitted).wider.any()


def test_many_recordings_are_blocks_and_few_are_cut() -> None:
    assert len(np.unique(block_of((50,) * 12))) == 12
    assert len(np.unique(block_of((500, 500)))) == 20
