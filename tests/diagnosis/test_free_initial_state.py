"""Free initial positions of motors behind elastic transmissions with velocity servos."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.free_initial_state import FreeInitialStates, free_initial_states
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales, Term, effect_values

JOINTS = ("wheel",)
STIFFNESS, DAMPING_TIME, GAP = 6.0, 0.02, 0.05
SHIFT = 0.1
"""Shift of the initial motor position from that of the model, rad."""
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
ELASTICITY = Hypothesis((Term("joint_elasticity", 0),), np.array([1.0 / STIFFNESS, DAMPING_TIME]))

BACKLASH = Hypothesis((Term("backlash", 0),), np.array([GAP, 0.01]))


def segment_from_rest(seconds: float = SECONDS) -> Segment:
    """A segment in which the wheel is commanded to rest for 1 s, then to oscillate."""
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


def test_a_link_moves_to_the_shifted_initial_position_of_its_motor() -> None:
    segment = segment_from_rest()
    shifted = position(replace(segment, motor_shift=np.full(1, SHIFT)), ELASTICITY)
    unshifted = position(segment, ELASTICITY)
    # The servo damps the motor with 5 N m s/rad, so the deflected transmission moves mainly the
    # link, in a damped oscillation with sqrt(k / J).
    early = (shifted - unshifted)[segment.time > 0.0][0, 0]
    assert abs(early) < 0.1 * SHIFT
    late = (shifted - unshifted)[-1, 0]
    # Without external forces, the final momentum equals the initial one. The impulse of the servo,
    # kv times the motor's travel, is therefore zero: motor and link end at the shifted position.
    assert late == pytest.approx(SHIFT, rel=1e-2)
    assert position(segment, EMPTY)[-1, 0] == pytest.approx(
        position(replace(segment, motor_shift=np.full(1, SHIFT)), EMPTY)[-1, 0], abs=1e-12
    ), "a shift must have no influence with a rigid transmission"


def recorded(segment: Segment, hypothesis: Hypothesis, shift: float, seed: int = 3) -> Segment:
    """The segment with noisy positions of a motion whose motor starts with a shift, rad."""
    unshifted = position(replace(segment, motor_shift=np.full(1, shift)), hypothesis)
    noise = NOISE * np.random.default_rng(seed).standard_normal(unshifted.shape)
    return replace(segment, position=unshifted + noise)


def estimated_starts(segment: Segment, hypothesis: Hypothesis) -> FreeInitialStates:
    return free_initial_states([segment], JOINTS, np.full(1, NOISE), 1, hypothesis, SCALES)


def residual_in_floors(
    segment: Segment, free_starts: FreeInitialStates, hypothesis: Hypothesis
) -> float:
    """RMS residual with the free initial state, in standard deviations of the noise."""
    predicted = position(replace(segment, motor_shift=free_starts.motor_shifts.get(0)), hypothesis)
    residual = free_starts.free[0].without_initial_error(segment.position - predicted)
    return float(np.sqrt(np.mean(residual**2))) / NOISE


@pytest.mark.parametrize(
    "hypothesis", [ELASTICITY, BACKLASH], ids=["elastic transmission", "backlash"]
)
@pytest.mark.parametrize("share", [-0.8, pytest.param(0.3, marks=pytest.mark.nightly), 0.8])
def test_the_initial_position_of_a_motor_is_estimated(hypothesis: Hypothesis, share: float) -> None:
    segment = segment_from_rest()
    shift = share * (EFFORT / STIFFNESS if hypothesis is ELASTICITY else 0.5 * GAP)
    segment = recorded(segment, hypothesis, shift)
    free_starts = estimated_starts(segment, hypothesis)
    # Contact of the teeth begins at a time step, so the residual is not exactly noise.
    assert residual_in_floors(segment, free_starts, hypothesis) < 1.5
    assert free_starts.motor_shifts[0] == pytest.approx(shift, abs=2e-3)
    link_only = estimated_starts(segment, EMPTY)
    assert not link_only.motor_shifts
    assert residual_in_floors(segment, link_only, hypothesis) > 30.0, (
        "a free position of the link alone must not explain the motion"
    )


def test_the_initial_state_of_a_segment_does_not_depend_on_the_sampling_rate_of_others() -> None:
    """Recordings of one set may have different sampling rates."""
    slow = segment_from_rest()
    fast = replace(
        slow, time=slow.time / 10.0, position=slow.position[:, :1], command_time=slow.time / 10.0
    )
    together = free_initial_states([slow, fast], JOINTS, np.full(1, NOISE), 1, EMPTY, SCALES).free
    for k, segment in enumerate((slow, fast)):
        (alone,) = estimated_starts(segment, EMPTY).free.values()
        assert together[k].solve == pytest.approx(alone.solve)


def test_an_inherited_transmission_frees_the_initial_state_like_one_of_the_hypothesis() -> None:
    segment = recorded(segment_from_rest(), ELASTICITY, 0.5 * EFFORT / STIFFNESS)
    fixed = effect_values([ELASTICITY], 1, SCALES)
    noise = np.full(1, NOISE)
    inherited = free_initial_states([segment], JOINTS, noise, 1, EMPTY, SCALES, fixed)
    searched = estimated_starts(segment, ELASTICITY)
    assert inherited.motor_shifts[0] == pytest.approx(searched.motor_shifts[0], rel=1e-9)
    assert inherited.free[0].response == pytest.approx(searched.free[0].response, rel=1e-9)


@pytest.mark.nightly
def test_the_initial_shift_of_a_motor_is_at_most_three_deflections_of_its_transmission() -> None:
    far = 40.0 * EFFORT / STIFFNESS
    found = estimated_starts(
        recorded(segment_from_rest(), ELASTICITY, far), ELASTICITY
    ).motor_shifts[0]
    assert found == pytest.approx(3.0 * EFFORT / STIFFNESS, rel=0.01)


def test_backlash_deflects_by_half_its_gap_and_position_servos_have_no_free_motor() -> None:
    segment = segment_from_rest(0.5)
    simulator = BatchSimulator([segment], JOINTS, threads=1)
    stretch = simulator.transmission_deflection(
        np.array([0]), effect_values([BACKLASH], 1, SCALES), np.full(1, EFFORT)
    )
    assert stretch[0, 0] == pytest.approx(0.5 * GAP + 0.01 * EFFORT)
    free = estimated_starts(segment, BACKLASH).free[0]
    assert free.response.shape == (len(segment.time), 2), (
        "the positions of link and motor must be free"
    )
    servo = replace(segment, mode="position", command=np.zeros_like(segment.command))
    assert not estimated_starts(servo, BACKLASH).free


def test_a_segment_whose_first_samples_are_lost_has_a_free_initial_state() -> None:
    whole = recorded(segment_from_rest(), EMPTY, 0.0)
    history = whole.time, whole.position, np.zeros_like(whole.position)
    lost = replace(whole, time=whole.time[100:], position=whole.position[100:], history=history)
    found = estimated_starts(lost, EMPTY).free[0]
    assert np.isfinite(found.solve).all()
    shift = np.full(lost.position.shape, 0.01)
    assert np.abs(found.without_initial_error(shift)).max() < 1e-4
