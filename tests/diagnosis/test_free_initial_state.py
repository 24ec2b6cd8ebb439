"""Where motors behind gears that give start is free under velocity servos, which keep it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.free_initial_state import FreeInitialStates, free_initial_states
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Scales, Term, effect_values
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment

JOINTS = ("wheel",)
STIFFNESS, DAMPING_TIME, GAP = 6.0, 0.02, 0.05
SHIFT = 0.1
"""rad by which the motor starts elsewhere than the model has it."""
NOISE, SECONDS = 1e-4, 4.0
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

PLAY = Hypothesis((Term("backlash", 0),), np.array([GAP, 0.01]))


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
    return BatchSimulator([segment], JOINTS, threads=1).simulate(np.array([0]), values)[0].position


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


def recorded(segment: Segment, hypothesis: Hypothesis, shift: float, seed: int = 3) -> Segment:
    """What the sensor reads where the motor starts shifted."""
    there = position(replace(segment, motor_shift=np.full(1, shift)), hypothesis)
    noise = NOISE * np.random.default_rng(seed).standard_normal(there.shape)
    return replace(segment, position=there + noise)


def starts(segment: Segment, hypothesis: Hypothesis) -> FreeInitialStates:
    return free_initial_states([segment], JOINTS, np.full(1, NOISE), 1, hypothesis, SCALES)


def left(segment: Segment, around: FreeInitialStates, hypothesis: Hypothesis) -> float:
    """In deviations of a sample."""
    predicted = position(replace(segment, motor_shift=around.motor_shifts.get(0)), hypothesis)
    off = around.free[0].freed(segment.position - predicted)
    return float(np.sqrt(np.mean(off**2))) / NOISE


@pytest.mark.parametrize("hypothesis", [SOFT, PLAY], ids=["soft", "play"])
@pytest.mark.parametrize("share", [-0.8, 0.3, 0.8])
def test_a_motor_is_found_where_it_started(hypothesis: Hypothesis, share: float) -> None:
    segment = resting()
    shift = share * (EFFORT / STIFFNESS if hypothesis is SOFT else 0.5 * GAP)
    segment = recorded(segment, hypothesis, shift)
    around = starts(segment, hypothesis)
    # A flank is met in one step or the next.
    assert left(segment, around, hypothesis) < 1.5
    assert around.motor_shifts[0] == pytest.approx(shift, abs=2e-3)
    links = starts(segment, EMPTY)
    assert not links.motor_shifts
    assert left(segment, links, hypothesis) > 30.0, "links alone do not explain it"


def test_every_start_is_known_as_well_as_its_own_samples_say() -> None:
    """Recordings of one set may be of different rates."""
    slow = resting()
    fast = replace(
        slow, time=slow.time / 10.0, position=slow.position[:, :1], command_time=slow.time / 10.0
    )
    together = free_initial_states([slow, fast], JOINTS, np.full(1, NOISE), 1, EMPTY, SCALES).free
    for k, segment in enumerate((slow, fast)):
        (alone,) = starts(segment, EMPTY).free.values()
        assert together[k].solve == pytest.approx(alone.solve)


def test_an_effect_under_every_hypothesis_frees_starts_as_one_of_it() -> None:
    segment = recorded(resting(), SOFT, 0.5 * EFFORT / STIFFNESS)
    fixed = effect_values([SOFT], 1, SCALES)
    noise = np.full(1, NOISE)
    beside = free_initial_states([segment], JOINTS, noise, 1, EMPTY, SCALES, fixed)
    named = starts(segment, SOFT)
    assert beside.motor_shifts[0] == pytest.approx(named.motor_shifts[0], rel=1e-9)
    assert beside.free[0].response == pytest.approx(named.free[0].response, rel=1e-9)


def test_a_motor_starts_within_a_few_stretches_of_its_gear() -> None:
    far = 40.0 * EFFORT / STIFFNESS
    found = starts(recorded(resting(), SOFT, far), SOFT).motor_shifts[0]
    assert found == pytest.approx(3.0 * EFFORT / STIFFNESS, rel=0.01)


def test_play_counts_by_half_of_it_and_position_servos_hold_their_motors() -> None:
    segment = resting(0.5)
    simulator = BatchSimulator([segment], JOINTS, threads=1)
    stretch = simulator.gear_stretch(
        np.array([0]), effect_values([PLAY], 1, SCALES), np.full(1, EFFORT)
    )
    assert stretch[0, 0] == pytest.approx(0.5 * GAP + 0.01 * EFFORT)
    free = starts(segment, PLAY).free[0]
    assert free.response.shape == (len(segment.time), 2), "the link's position and the motor's"
    servo = replace(segment, mode="position", command=np.zeros_like(segment.command))
    assert not starts(servo, PLAY).free
