"""Intervals of the reliability diagram."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "concealed"))

import reliability


@pytest.mark.parametrize("every", range(1, 60))
def test_the_interval_of_a_share_contains_it_with_none_and_all_right(every: int) -> None:
    for right in (0, every // 2, every):
        low, high = reliability.wilson(right, every)
        assert 0.0 <= low <= right / every <= high <= 1.0


def test_the_interval_is_that_of_wilson() -> None:
    # Newcombe, Statistics in Medicine 17 (1998), table I: 81 of 263 and 0 of 20.
    assert reliability.wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert reliability.wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
