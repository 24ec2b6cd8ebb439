"""Backlash whose teeth a weight always presses to one side: nearly a constant offset."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from searched import searched

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem, joint_scales, replay_nominal
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment
from pytest_twin.estimation.hypothesis import EMPTY, Term

MODEL = """\
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<inertial mass="1" pos="0.2 0 0" diaginertia="0.001 0.012 0.012"/>
<joint name="j" axis="0 1 0" damping="0.1" frictionloss="0.05" armature="0.02"/>
</body></worldbody><actuator><position joint="j" kp="60" kv="3"/></actuator></mujoco>
"""
GAP, TEETH, SAG = 0.03, 4e3, 1.9599 / 60.0
NOISE = 5e-5
SAMPLE, SECONDS = 0.01, 4.0
JOINT = Term("backlash", 0)


def motion(seed: int) -> FloatArray:
    """(samples,) rad: a smooth motion from rest."""
    time = SAMPLE * np.arange(round(SECONDS / SAMPLE))
    rng = np.random.default_rng(seed)
    waves = np.sin(2.0 * np.pi * rng.uniform(0.2, 1.2, 4) * time[:, None] + rng.uniform(0, 6, 4))
    return np.asarray(0.15 * waves.sum(axis=1) * np.minimum(time / 0.8, 1.0) ** 2)


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Two recordings of a link that hangs sideways behind a gear with backlash."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    # The motor holds the weight and is half a gap away from the link.
    start = SAG + GAP / 2.0 + 1.9599 / TEETH
    segments = []
    for seed in range(2):
        command = motion(seed)[:, None]
        time: FloatArray = SAMPLE * np.arange(len(command), dtype=np.float64)
        segments.append(
            Segment(
                trial=seed, model=model, mode="position", start=0.0, time=time,
                position=np.zeros_like(command), velocity=None, effort=None, command_time=time,
                command=command, initial_position=np.array([start]), initial_velocity=np.zeros(1),
            )
        )  # fmt: skip
    hidden = {"gap": np.full((1, 1), GAP), "tooth_compliance": np.full((1, 1), 1.0 / TEETH)}
    plant = BatchSimulator(segments, ("j",), threads=1)
    real = plant.simulate(
        np.arange(2), {"backlash": {k: np.tile(v, (2, 1)) for k, v in hidden.items()}}
    )
    rng = np.random.default_rng(3)
    segments = [
        replace(s, position=p.position + NOISE * rng.standard_normal(p.position.shape))
        for s, p in zip(segments, real, strict=True)
    ]
    simulator = BatchSimulator(segments, ("j",), threads=1)
    scales = joint_scales(simulator, replay_nominal(simulator))
    floor = np.full(1, NOISE)
    return Problem(simulator, np.arange(2), np.zeros(0, np.int64), floor, scales).at(EMPTY)


def test_backlash_is_found_where_its_weight_makes_it_an_offset(problem: Problem) -> None:
    found = searched(problem).incumbent.hypothesis
    assert found.terms == (JOINT,)
    assert found.theta[0] == pytest.approx(GAP, rel=0.05)
