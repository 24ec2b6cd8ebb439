"""Propagation of small deviations through the linearized dynamics."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from simulated_robots import PENDULUM

from pytest_twin.diagnosis.first_order import linearized_dynamics
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.linearized_dynamics import LinearizedDynamics
from pytest_twin.diagnosis.first_order.sensitivities import linearize
from pytest_twin.diagnosis.problem import Problem, joint_scales, replay_nominal
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment
from pytest_twin.estimation.hypothesis import EMPTY, Term

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


@pytest.mark.parametrize(
    ("friction", "moves"), [(0.0, True), (0.1, True), (3.0, False)],
    ids=["without friction", "friction below the load", "friction above the load"],
)  # fmt: skip
def test_a_slow_joint_is_held_only_by_friction_that_is_above_its_load(
    friction: float, moves: bool
) -> None:
    """A velocity servo has the command zero for 3 s. Its load moves it, or friction holds it.

    It creeps at 1 % of its typical velocity. A spring changes this velocity.
    """
    drive = '<velocity joint="a" kv="200"/>'
    xml = PENDULUM.format(drive=drive).replace('frictionloss=".1"', f'frictionloss="{friction}"')
    time = 0.01 * np.arange(400, dtype=np.float64)
    command = np.where(time < 1.0, np.sin(np.pi * np.minimum(time, 1.0)), 0.0)[:, None]
    segment = Segment(
        trial=0, model=mujoco.MjModel.from_xml_string(xml), mode="velocity", start=0.0, time=time,
        position=np.zeros((len(time), 1)), velocity=None, effort=None,
        command_time=time, command=command, initial_position=np.zeros(1),
        initial_velocity=np.zeros(1),
    )  # fmt: skip
    simulator = BatchSimulator([segment], ("a",), threads=1)
    segment = replace(segment, position=replay_nominal(simulator)[0].position)
    simulator = BatchSimulator([segment], ("a",), threads=1)
    scales = joint_scales(simulator, replay_nominal(simulator))
    problem = Problem(simulator, np.array([0]), np.zeros(0, np.int64), np.full(1, 1e-5), scales)
    problem = problem.at(EMPTY)
    spring = Term("joint_spring", 0)
    stiffness = 0.5 / scales.value(spring.parameters[0], 0)
    sprung = EMPTY.with_term(spring, np.array([stiffness, 0.0]))
    linear = linearize(problem, problem.fit, EMPTY)
    assert linear is not None
    first_order = linear.differences([sprung])[0][:, 0]
    without, with_it = problem.residuals([EMPTY, sprung], problem.fit)
    simulated = bins(problem, problem.fit).mean(without - with_it)[:, 0]
    after = np.linspace(0.0, 4.0, len(simulated)) > 1.5
    assert (np.ptp(simulated[after]) > 1e-3) == moves
    assert np.abs(first_order - simulated).max() < 0.1 * np.abs(simulated).max()
