"""Numbers that carry variants of themselves through a computation."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from variants import WithVariants

RESIDUALS = np.array([0.5, 1.2, 5.0])


def halved_and_doubled(value: float, noted: set[str]) -> Any:
    kind = type(value)
    return WithVariants(value, {"half": kind(0.5 * value), "double": 2 * value}, noted)


@pytest.mark.parametrize(
    ("program", "value", "expected"),
    [
        (lambda x: x < 5.0, 2.0, set()),
        (lambda x: x < 1.5, 2.0, {"half"}),
        (lambda x: x >= 3.0, 2.0, {"double"}),
        (lambda x: 10.0 * x + 1.0 > 100.0, 2.0, set()),
        (lambda x: 10.0 * x + 1.0 > 15.0, 2.0, {"half"}),
        (lambda x: (x * RESIDUALS).max() > 15.0, 2.0, {"double"}),
        (lambda x: RESIDUALS[2] > x * RESIDUALS[0], 2.0, set()),
        (lambda x: (x < RESIDUALS).sum(), 2.0, {"half"}),
        (lambda x: (x < RESIDUALS).any(), 20.0, set()),
        (lambda x: np.where(RESIDUALS > 9.0, x, 0.0).sum(), 2.0, set()),
        (lambda x: np.clip(RESIDUALS, 0.0, x).tolist(), 20.0, set()),
        (lambda x: list(range(x)), 4, {"half", "double"}),
        (lambda x: [1, 2][:x], 8, {"half", "double"}),
        (lambda x: math.exp(x), 2.0, {"half", "double"}),
        (lambda x: f"{x:g}", 2.0, {"half", "double"}),
        (lambda x: min(3.0, x) if x > 0.1 else 0.0, 20.0, set()),
        (lambda x: RESIDUALS.copy().__iadd__(x), 2.0, {"half", "double"}),
        (lambda x: round(x / 100.0) > 0, 2.0, set()),
    ],
)
def test_variants_are_noted_exactly_if_the_program_would_continue_differently(
    program: Callable[[Any], Any], value: float, expected: set[str]
) -> None:
    noted: set[str] = set()
    program(halved_and_doubled(value, noted))
    assert noted == expected


@pytest.mark.parametrize("program", [lambda x: RESIDUALS * x, lambda x: 1.0 - x**2, abs])
def test_results_have_the_value_of_each_variant(program: Callable[[Any], Any]) -> None:
    noted: set[str] = set()
    result = program(halved_and_doubled(2.0, noted))
    assert result.value == pytest.approx(program(2.0))
    assert result.variants["half"] == pytest.approx(program(1.0))
    assert result.variants["double"] == pytest.approx(program(4.0))
    assert noted == set()


def test_two_numbers_in_one_expression_keep_their_variants_apart() -> None:
    noted: set[str] = set()
    first = WithVariants(2.0, {"first": 4.0}, noted)
    second = WithVariants(3.0, {"second": 1.0}, noted)
    assert first < second
    assert noted == {"first", "second"}
    noted.clear()
    assert first + second < 7.5
    assert noted == set()
