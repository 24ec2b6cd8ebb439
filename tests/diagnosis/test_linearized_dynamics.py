"""Small deviations as they are carried from sample to sample."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.diagnosis.first_order import linearized_dynamics
from pytest_twin.diagnosis.first_order.linearized_dynamics import LinearizedDynamics

SEGMENTS, SAMPLES, JOINTS, COLUMNS = 3, 40, 2, 5
RNG = np.random.default_rng(7)


@pytest.mark.parametrize("in_cache", [1, 200, 100_000], ids=["one by one", "three", "all"])
def test_deviations_are_carried_one_after_the_other(
    in_cache: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linearized_dynamics, "_IN_CACHE", in_cache)
    step = 0.5 * RNG.standard_normal((SAMPLES - 1, SEGMENTS, 2 * JOINTS, 2 * JOINTS))
    push = RNG.standard_normal((SAMPLES - 1, SEGMENTS, 2 * JOINTS, JOINTS))
    none = np.zeros((SEGMENTS, SAMPLES, JOINTS))
    force = RNG.standard_normal((SEGMENTS, SAMPLES, JOINTS, COLUMNS))
    initial = RNG.standard_normal((SEGMENTS, 2 * JOINTS, COLUMNS))
    carrying = LinearizedDynamics(step, push, none, none)
    found = carrying.trajectory(force, initial)
    for s in range(SEGMENTS):
        for k in range(COLUMNS):
            state = initial[s, :, k]
            assert found[s, 0, :, k] == pytest.approx(state)
            for t in range(SAMPLES - 1):
                mean = (force[s, t, :, k] + force[s, t + 1, :, k]) / 2.0
                state = step[t, s] @ state + push[t, s] @ mean
                assert found[s, t + 1, :, k] == pytest.approx(state)


def test_a_force_at_one_joint_is_one_that_is_nothing_at_the_others() -> None:
    step = 0.5 * RNG.standard_normal((SAMPLES - 1, SEGMENTS, 2 * JOINTS, 2 * JOINTS))
    push = RNG.standard_normal((SAMPLES - 1, SEGMENTS, 2 * JOINTS, JOINTS))
    none = np.zeros((SEGMENTS, SAMPLES, JOINTS))
    joint = RNG.integers(JOINTS, size=COLUMNS)
    force = RNG.standard_normal((SEGMENTS, SAMPLES, COLUMNS))
    everywhere = np.zeros((SEGMENTS, SAMPLES, JOINTS, COLUMNS))
    everywhere[:, :, joint, range(COLUMNS)] = force
    initial = RNG.standard_normal((SEGMENTS, 2 * JOINTS, COLUMNS))
    carrying = LinearizedDynamics(step, push, none, none)
    alone = np.concatenate(list(carrying.of_joints(force, joint, initial))).swapaxes(0, 1)
    whole = carrying.trajectory(everywhere, initial)
    assert alone.shape[1] == SAMPLES
    assert alone == pytest.approx(whole, rel=1e-12)
