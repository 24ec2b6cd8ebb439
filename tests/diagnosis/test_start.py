"""Where motors behind gears that give start is free under velocity servos, which keep it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Scales, Term, effect_values
from pytest_twin.diagnosis.start import free_starts
from pytest_twin.effects.base import FloatArray
from pytest_twin.effects.rows import RowSimulator, Segment

JOINTS = ("wheel",)
STIFFNESS, DAMPING_TIME, GAP = 6.0, 0.02, 0.05
SHIFT = 0.1
"""rad by which the motor starts elsewhere than the model has it."""
NOISE, WIDTH, SECONDS = 1e-4, 0.06, 4.0
EFFORT = 0.5
SCALES = Scales({"one": np.ones(1), "compliance": np.ones(1), "position": np.ones(1),
                 "time": np.ones(1), "effort": np.full(1, EFFORT)})  # fmt: skip
WHEEL = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="rim">
      <inertial pos="0 0 0" mass="1" diaginertia="0.02 0.02 0.02"/>
      <joint name="wheel" type="hinge" axis="0 0 1" armature="0.01"/>
    </body>
  </worldbody>
  <actuator><velocity name="wheel" joint="wheel" kv="5"/></actuator>
</mujoco>
"""
SOFT = Hypothesis((Term("joint_elasticity", 0),), np.array([1.0 / STIFFNESS, DAMPING_TIME]))


def resting(seconds: float = SECONDS) -> Segment:
    """The wheel is told to rest, then to turn to and fro."""
    time = 0.005 * np.arange(round(seconds / 0.005), dtype=np.float64)
    command = np.where(time < 1.0, 0.0, np.sin(2.0 * np.pi * time))[:, None]
    return Segment(
        trial=0, model=mujoco.MjModel.from_xml_string(WHEEL), mode="velocity", start=0.0, time=time,
        position=np.zeros((len(time), 1)), velocity=None, effort=None, command_time=time,
        command=command, initial_position=np.zeros(1), initial_velocity=np.zeros(1),
    )  # fmt: skip


def position(segment: Segment, hypothesis: Hypothesis) -> FloatArray:
    values = effect_values([hypothesis], 1, SCALES)
    return RowSimulator([segment], JOINTS, threads=1).simulate(np.array([0]), values)[0].position


def test_a_link_follows_its_motor_to_where_that_starts() -> None:
    segment = resting()
    moved = position(replace(segment, motor_shift=np.full(1, SHIFT)), SOFT)
    there = position(segment, SOFT)
    # The servo resists at 5 N m s/rad: most of what the gear is stretched by moves the link, and
    # that turns with sqrt(k / J), damped.
    early = (moved - there)[segment.time > 0.0][0, 0]
    assert abs(early) < 0.1 * SHIFT
    late = (moved - there)[-1, 0]
    # No force acts from outside: momentum ends where it began, so that what the motor's drive did,
    # kv times its way, is nothing: the motor is back where it was put, and the link with it.
    assert late == pytest.approx(SHIFT, rel=1e-2)
    assert position(segment, EMPTY)[-1, 0] == pytest.approx(
        position(replace(segment, motor_shift=np.full(1, SHIFT)), EMPTY)[-1, 0], abs=1e-12
    ), "without a gear that gives the motor is where the link is"


def test_residuals_are_freed_of_where_the_motor_starts() -> None:
    segment = resting()
    there = position(segment, SOFT)
    off = position(replace(segment, motor_shift=np.full(1, 0.5 * EFFORT / STIFFNESS)), SOFT) - there
    noise = np.full(1, NOISE)
    around = free_starts([segment], JOINTS, noise, WIDTH, 1, SOFT, SCALES)[0]
    rigid = free_starts([segment], JOINTS, noise, WIDTH, 1, EMPTY, SCALES)[0]
    assert np.abs(off).max() > 100.0 * NOISE
    assert np.sqrt(np.mean(around.freed(off) ** 2)) < NOISE
    assert np.sqrt(np.mean(rigid.freed(off) ** 2)) > 30.0 * NOISE, "links alone do not explain it"


def test_a_motor_starts_no_further_off_than_its_gear_stretches() -> None:
    segment = resting()
    far = 40.0 * EFFORT / STIFFNESS
    moved = position(replace(segment, motor_shift=np.full(1, far)), SOFT) - position(segment, SOFT)
    noise = np.full(1, 0.01)
    freed = free_starts([segment], JOINTS, noise, WIDTH, 1, SOFT, SCALES)[0].solve @ moved.ravel()
    # A prior of one stretch against all samples: little is held back, and not nothing.
    assert 0.99 * far < freed[-1] < far


def test_play_counts_by_half_of_it_and_position_servos_hold_their_motors() -> None:
    play = Hypothesis((Term("backlash", 0),), np.array([GAP, 0.01]))
    segment = resting(0.5)
    simulator = RowSimulator([segment], JOINTS, threads=1)
    stretch = simulator.gear_stretch(
        np.array([0]), effect_values([play], 1, SCALES), np.full(1, EFFORT)
    )
    assert stretch[0, 0] == pytest.approx(0.5 * GAP + 0.01 * EFFORT)
    noise = np.full(1, NOISE)
    free = free_starts([segment], JOINTS, noise, WIDTH, 1, play, SCALES)[0]
    assert free.response.shape == (len(segment.time), 2), "the link's position and the motor's"
    servo = replace(segment, mode="position", command=np.zeros_like(segment.command))
    assert not free_starts([servo], JOINTS, noise, WIDTH, 1, play, SCALES)
