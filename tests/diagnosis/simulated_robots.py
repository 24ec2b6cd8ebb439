"""Problems of robots with hidden effects, which the package itself simulates."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem, joint_scales, replay_nominal
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term, effect_values

NOISE, SAMPLE, SECONDS = 2e-4, 0.01, 3.0

PENDULUM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="a" axis="0 1 0" damping=".2" armature=".02" frictionloss=".1"/>
<inertial pos="0 0 -.2" mass="1" diaginertia=".01 .01 .001"/>
</body></worldbody><actuator>{drive}</actuator></mujoco>
"""
SERVO, MOTOR = '<position joint="a" kp="60" kv="2"/>', '<motor joint="a"/>'
SLIDER = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="a" type="slide" axis="1 0 0" damping="20"/>
<inertial pos=".1 .05 .02" mass="2" diaginertia=".01 .02 .03"/>
</body></worldbody><actuator><position joint="a" kp="2000" kv="60"/></actuator></mujoco>
"""
PLANAR = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="a" axis="0 1 0" damping=".5" armature=".05"/>
<inertial pos="0 0 .2" mass="2" diaginertia=".03 .03 .002"/>
<body pos="0 0 .4"><joint name="b" axis="0 1 0" damping=".3" armature=".03"/>
<inertial pos="0 0 .15" mass="1" diaginertia=".01 .01 .001"/></body></body></worldbody>
<actuator><position joint="a" kp="150" kv="8"/><position joint="b" kp="80" kv="4"/></actuator>
</mujoco>
"""


def command(mode: str, joints: int, seed: int) -> FloatArray:
    """(samples, joints) smooth commands that begin at rest, rad or N*m."""
    rng = np.random.default_rng(seed)
    t = SAMPLE * np.arange(round(SECONDS / SAMPLE))
    size = 0.4 if mode == "position" else 2.5
    wave = sum(
        np.sin(2 * np.pi * t[:, None] * rng.uniform(0.4, 1.6, joints) + rng.uniform(0, 6, joints))
        for _ in range(3)
    )
    return np.asarray(size / 2 * wave * np.minimum(t / 0.4, 1.0)[:, None])


def with_values(problem: Problem, hidden: dict[Term, dict[str, float]]) -> Hypothesis:
    h = EMPTY
    for term, values in hidden.items():
        h = h.with_term(
            term,
            np.array([
                values.get(p.name, p.absent_value * problem.scales.value(p, term.joint))
                / problem.scales.value(p, term.joint)
                for p in term.parameters
            ]),
        )  # fmt: skip
    return h


def problem_of(
    xml: str, mode: str, hidden: dict[Term, dict[str, float]], *, seed: int = 1
) -> Problem:
    """Two fit recordings of a robot with hidden effects, which the package itself simulates."""
    model = mujoco.MjModel.from_xml_string(xml)
    joints = tuple(model.joint(i).name for i in range(model.njnt))
    time: FloatArray = SAMPLE * np.arange(round(SECONDS / SAMPLE), dtype=np.float64)
    still = np.zeros(len(joints))
    segments = [
        Segment(
            trial=k, model=model, mode=mode, start=0.0, time=time,
            position=command(mode, len(joints), k), velocity=None, effort=None,
            command_time=time, command=command(mode, len(joints), k),
            initial_position=still, initial_velocity=still,
        )
        for k in range(2)
    ]  # fmt: skip
    simulator = BatchSimulator(segments, joints, threads=1)
    scales = joint_scales(simulator, replay_nominal(simulator))
    noise = np.full(len(joints), NOISE)
    problem = Problem(simulator, np.arange(2), np.zeros(0, np.int64), noise, scales)
    rng = np.random.default_rng(seed)
    values = effect_values([with_values(problem, hidden)] * 2, len(joints), scales)
    measured = [
        replace(s, position=p.position + NOISE * rng.standard_normal(p.position.shape))
        for s, p in zip(segments, simulator.simulate(np.arange(2), values), strict=True)
    ]
    simulator = BatchSimulator(measured, joints, threads=1)
    out = Problem(simulator, np.arange(2), np.zeros(0, np.int64), noise, scales)
    return out.at(EMPTY)
