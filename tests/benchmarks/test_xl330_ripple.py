"""Distinguish torque ripple that depends on the joint angle from other periodic forces."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "real"))

from xl330_ripple import POSITIONS, STEP, WAVENUMBERS, alike, mean_alike, shared

from pytest_twin.arrays import FloatArray

SLOTS = 150.0


def _upward_motions(tied: bool) -> list[FloatArray]:
    """Four upward motions over different ranges, with noise and a wave.

    The wave is fixed to the joint angle if ``tied``, else to the start of the motion.
    """
    random = np.random.default_rng(3)
    out = []
    for k in range(4):
        first = 0.0 if tied else 0.01 * k
        each = np.cos(SLOTS * (POSITIONS - first)) + random.normal(0.0, 0.5, len(POSITIONS))
        each[(0.05 * k > POSITIONS) | (0.7 + 0.05 * k < POSITIONS)] = np.nan
        out.append(each)
    return out


def test_ripple_correlates_only_if_it_is_fixed_to_the_joint_angle() -> None:
    still = np.zeros(4, dtype=int)
    assert mean_alike(_upward_motions(tied=True), still) > 0.5
    assert mean_alike(_upward_motions(tied=False), still) < 0.2
    one, other, *_ = _upward_motions(tied=True)
    half_a_wave = round(np.pi / SLOTS / STEP)
    assert alike(one, other, half_a_wave) < -0.3
    assert alike(one, other, -half_a_wave) < -0.3


def test_motions_with_too_little_overlap_are_not_compared() -> None:
    one, other, *_ = _upward_motions(tied=True)
    one[POSITIONS > 0.2] = np.nan
    assert np.isnan(alike(one, other, 0))


def test_the_number_of_slots_is_the_wavenumber_common_to_all_motions() -> None:
    found = shared(_upward_motions(tied=True), np.zeros(4))
    assert WAVENUMBERS[found.argmax()] == pytest.approx(SLOTS, abs=1.0)
    assert found.max() == pytest.approx(0.5 / 0.75, abs=0.05)
    moved = shared(_upward_motions(tied=True), 0.01 * np.arange(4))
    assert moved.max() < 0.5 * found.max()
