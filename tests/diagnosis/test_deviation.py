"""Small deviations as they are carried from sample to sample."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.diagnosis.first_order.deviation import Deviation

SEGMENTS, SAMPLES, JOINTS, COLUMNS = 3, 40, 2, 5
RNG = np.random.default_rng(7)


def test_deviations_are_carried_one_after_the_other() -> None:
    step = 0.5 * RNG.standard_normal((SAMPLES - 1, SEGMENTS, 2 * JOINTS, 2 * JOINTS))
    push = RNG.standard_normal((SEGMENTS, SAMPLES - 1, 2 * JOINTS, JOINTS))
    none = np.zeros((SEGMENTS, SAMPLES, JOINTS))
    force = RNG.standard_normal((SEGMENTS, SAMPLES, JOINTS, COLUMNS))
    initial = RNG.standard_normal((SEGMENTS, 2 * JOINTS, COLUMNS))
    found = Deviation(step, push, none, none).of(force, initial)
    for s in range(SEGMENTS):
        for k in range(COLUMNS):
            state = initial[s, :, k]
            assert found[s, 0, :, k] == pytest.approx(state)
            for t in range(SAMPLES - 1):
                mean = (force[s, t, :, k] + force[s, t + 1, :, k]) / 2.0
                state = step[t, s] @ state + push[s, t] @ mean
                assert found[s, t + 1, :, k] == pytest.approx(state)
