"""Propagation of small deviations through the linearized dynamics."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.diagnosis.first_order import linearized_dynamics
from pytest_twin.diagnosis.first_order.linearized_dynamics import LinearizedDynamics

SEGMENTS, SAMPLES, JOINTS, COLUMNS = 3, 40, 2, 5
RNG = np.random.default_rng(7)


@pytest.mark.parametrize(
    "in_cache",
    [1, 200, 100_000],
    ids=["one sample at a time", "three samples at a time", "all samples at once"],
)
def test_a_trajectory_of_deviations_follows_the_recursion_over_the_samples(
    in_cache: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linearized_dynamics, "_IN_CACHE", in_cache)
    step = 0.5 * RNG.standard_normal((SAMPLES - 1, SEGMENTS, 2 * JOINTS, 2 * JOINTS))
    push = RNG.standard_normal((SAMPLES - 1, SEGMENTS, 2 * JOINTS, JOINTS))
    none = np.zeros((SEGMENTS, SAMPLES, JOINTS))
    force = RNG.standard_normal((SEGMENTS, SAMPLES, JOINTS, COLUMNS))
    initial = RNG.standard_normal((SEGMENTS, 2 * JOINTS, COLUMNS))
    dynamics = LinearizedDynamics(step, push, none, none)
    found = dynamics.trajectory(force, initial)
    for s in range(SEGMENTS):
        for k in range(COLUMNS):
            state = initial[s, :, k]
            assert found[s, 0, :, k] == pytest.approx(state)
            for t in range(SAMPLES - 1):
                mean = (force[s, t, :, k] + force[s, t + 1, :, k]) / 2.0
                state = step[t, s] @ state + push[t, s] @ mean
                assert found[s, t + 1, :, k] == pytest.approx(state)


def test_a_force_at_one_joint_equals_a_force_vector_that_is_zero_at_the_other_joints() -> None:
    step = 0.5 * RNG.standard_normal((SAMPLES - 1, SEGMENTS, 2 * JOINTS, 2 * JOINTS))
    push = RNG.standard_normal((SAMPLES - 1, SEGMENTS, 2 * JOINTS, JOINTS))
    none = np.zeros((SEGMENTS, SAMPLES, JOINTS))
    joint = RNG.integers(JOINTS, size=COLUMNS)
    force = RNG.standard_normal((SEGMENTS, SAMPLES, COLUMNS))
    everywhere = np.zeros((SEGMENTS, SAMPLES, JOINTS, COLUMNS))
    everywhere[:, :, joint, range(COLUMNS)] = force
    initial = RNG.standard_normal((SEGMENTS, 2 * JOINTS, COLUMNS))
    dynamics = LinearizedDynamics(step, push, none, none)
    single = np.concatenate(list(dynamics.propagate_joint_forces(force, joint, initial))).swapaxes(
        0, 1
    )
    full = dynamics.trajectory(everywhere, initial)
    assert single.shape[1] == SAMPLES
    assert single == pytest.approx(full, rel=1e-12)
