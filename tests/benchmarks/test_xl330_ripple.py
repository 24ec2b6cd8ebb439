"""What tells a force that is tied to the angle from one that is not."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "real"))

from xl330_ripple import POSITIONS, STEP, WAVENUMBERS, alike, mean_alike, shared

from pytest_twin.arrays import FloatArray

SLOTS = 150.0


def _rises(tied: bool) -> list[FloatArray]:
    """Four rises over ways of their own, with a wave that begins at the same angle or where they
    do, and noise.
    """
    random = np.random.default_rng(3)
    out = []
    for k in range(4):
        first = 0.0 if tied else 0.01 * k
        each = np.cos(SLOTS * (POSITIONS - first)) + random.normal(0.0, 0.5, len(POSITIONS))
        each[(0.05 * k > POSITIONS) | (0.7 + 0.05 * k < POSITIONS)] = np.nan
        out.append(each)
    return out


def test_slots_are_alike_at_the_same_angle_and_not_elsewhere() -> None:
    still = np.zeros(4, dtype=int)
    assert mean_alike(_rises(tied=True), still) > 0.5
    assert mean_alike(_rises(tied=False), still) < 0.2
    one, other, *_ = _rises(tied=True)
    half_a_wave = round(np.pi / SLOTS / STEP)
    assert alike(one, other, half_a_wave) < -0.3
    assert alike(one, other, -half_a_wave) < -0.3


def test_rises_that_have_too_little_in_common_are_not_compared() -> None:
    one, other, *_ = _rises(tied=True)
    one[POSITIONS > 0.2] = np.nan
    assert np.isnan(alike(one, other, 0))


def test_the_number_of_slots_is_what_all_share() -> None:
    found = shared(_rises(tied=True), np.zeros(4))
    assert WAVENUMBERS[found.argmax()] == pytest.approx(SLOTS, abs=1.0)
    assert found.max() == pytest.approx(0.5 / 0.75, abs=0.05)
    moved = shared(_rises(tied=True), 0.01 * np.arange(4))
    assert moved.max() < 0.5 * found.max()
