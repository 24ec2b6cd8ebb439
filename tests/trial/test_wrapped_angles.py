"""Angles recorded within one turn are unwrapped, or refused where the turns are unknown."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pytest_twin.trial.wrapped_angles import TURN, AmbiguousTurnsError, JointMotion, unwrap

NONE = np.empty(0)


def wrapped(values: np.ndarray, start: float) -> np.ndarray:
    """Values within one turn that begins at ``start``."""
    return start + np.mod(values - start, TURN)


def motion(
    time: np.ndarray, position: np.ndarray, command: np.ndarray | None = None
) -> JointMotion:
    if command is None:
        return JointMotion(time, position, NONE, NONE)
    return JointMotion(time, position, time, command)


@st.composite
def motions(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    """Times and positions of a smooth random motion: any rate, speed, jitter and gaps."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(2, 400))
    interval = draw(st.sampled_from([0.001, 0.01, 0.02, 0.1]))
    intervals = interval * (1.0 + 0.3 * rng.random(count))
    for _ in range(draw(st.integers(0, 2))):
        intervals[rng.integers(count)] += draw(st.floats(0.0, 2.0))
    time = np.cumsum(intervals)
    speed = draw(st.floats(0.1, 25.0))
    frequencies = rng.uniform(0.05, 2.0, 3)
    phases = rng.uniform(0.0, TURN, 3)
    shares = rng.dirichlet(np.ones(4))
    position = speed * shares[3] * time
    for share, frequency, phase in zip(shares, frequencies, phases, strict=False):
        rate = TURN * frequency
        position = position + speed * share / rate * np.sin(rate * time + phase)
    # Nothing in the samples shows a motion that is faster than usual in a gap alone.
    speeds = np.abs(np.diff(position)) / np.diff(time)
    usual = np.diff(time) <= 1.5 * np.median(np.diff(time))
    assume(speeds.max() <= max(14.0, 1.9 * speeds[usual].max(initial=0.0)))
    return time, position + rng.uniform(-10.0, 10.0), rng


@settings(deadline=None)
@given(motions(), st.sampled_from([-np.pi, 0.0]))
def test_wrapped_positions_are_unwrapped_or_refused(
    drawn: tuple[np.ndarray, np.ndarray, np.random.Generator], start: float
) -> None:
    time, position, _ = drawn
    try:
        found = unwrap(motion(time, wrapped(position, start)), None)
    except AmbiguousTurnsError:
        return
    if any("by assumption" in note for note in found.notes):
        return
    np.testing.assert_allclose(
        found.position - found.position[0], position - position[0], atol=1e-6
    )


@settings(deadline=None)
@given(motions(), st.sampled_from([-np.pi, 0.0]), st.booleans(), st.booleans())
def test_positions_and_commands_are_unwrapped_into_one_turn_or_refused(
    drawn: tuple[np.ndarray, np.ndarray, np.random.Generator],
    start: float,
    wrap_states: bool,
    wrap_commands: bool,
) -> None:
    time, position, rng = drawn
    command = position + rng.uniform(-0.2, 0.2) + 0.05 * rng.standard_normal(len(time))
    states = wrapped(position, start) if wrap_states else position
    sent = wrapped(command, start) if wrap_commands else command
    try:
        found = unwrap(motion(time, states, sent), None)
    except AmbiguousTurnsError:
        return
    if any("by assumption" in note for note in found.notes):
        return
    np.testing.assert_allclose(found.position - found.command, position - command, atol=1e-6)
    np.testing.assert_allclose(
        found.position - found.position[0], position - position[0], atol=1e-6
    )


@settings(deadline=None)
@given(motions())
def test_positions_beyond_a_turn_are_kept(
    drawn: tuple[np.ndarray, np.ndarray, np.random.Generator],
) -> None:
    time, position, _ = drawn
    if np.ptp(position) < 1.1 * TURN:
        return
    found = unwrap(motion(time, position, position), None)
    assert found.notes == ()
    np.testing.assert_array_equal(found.position, position)


def test_a_fast_joint_at_a_low_rate_is_refused() -> None:
    time = np.arange(50) * 0.1
    with pytest.raises(AmbiguousTurnsError, match=r"turns by 2\.\d+ or 3\.\d+ rad from one sample"):
        unwrap(motion(time, wrapped(28.0 * time, -np.pi)), None)


def test_a_gap_in_which_the_joint_may_turn_is_refused() -> None:
    time = np.concatenate([np.arange(200) * 0.01, 4.0 + np.arange(100) * 0.01])
    with pytest.raises(AmbiguousTurnsError, match=r"in the 2\.01 s without a sample after 1\.99 s"):
        unwrap(motion(time, wrapped(2.0 * time, -np.pi)), None)


def test_commands_decide_what_happened_in_a_gap() -> None:
    command_time = np.arange(400) * 0.01
    seen = (command_time < 1.0) | (command_time > 3.0)
    truth = 2.0 * command_time
    found = unwrap(
        JointMotion(command_time[seen], wrapped(truth, -np.pi)[seen], command_time, truth), None
    )
    np.testing.assert_allclose(found.position, truth[seen], atol=1e-9)


def test_a_step_of_the_command_by_more_than_half_a_turn_is_kept() -> None:
    time = np.arange(300) * 0.01
    command = np.where(time < 1.0, -1.7, 1.7)
    position = np.clip(-1.7 + 8.0 * np.maximum(time - 1.0, 0.0), -1.7, 1.7)
    found = unwrap(motion(time, position, command), None)
    assert found.notes == ()
    np.testing.assert_array_equal(found.command, command)


def test_one_wrong_sample_is_no_turn() -> None:
    time = np.arange(300) * 0.01
    position = 3.0 + 0.05 * np.sin(time)
    position[150] = -0.5
    found = unwrap(motion(time, position), None)
    assert found.notes == ()
    np.testing.assert_array_equal(found.position, position)


@pytest.mark.parametrize(
    ("limits", "truth"),
    [
        ((-2 * np.pi, 2 * np.pi), 2.0 + 1.5 * np.sin(np.arange(400) * 0.01)),
        ((0.5, 5.5), 3.0 + 1.2 * np.sin(np.arange(400) * 0.01)),
        ((0.5, 5.5), 4.0 + 0.2 * np.sin(np.arange(400) * 0.01)),
    ],
)
def test_a_joint_with_a_range_is_unwrapped_into_it(
    limits: tuple[float, float], truth: np.ndarray
) -> None:
    time = np.arange(400) * 0.01
    found = unwrap(motion(time, wrapped(truth, -np.pi)), limits)
    np.testing.assert_allclose(found.position, truth, atol=1e-9)
    assert len(found.notes) == 1


def test_a_joint_whose_range_is_less_than_a_turn_is_kept_where_it_is_inside() -> None:
    time = np.arange(400) * 0.01
    position = np.where(time < 2.0, -2.9, 2.9)
    found = unwrap(motion(time, position), (-3.0, 3.0))
    np.testing.assert_array_equal(found.position, position)


def test_a_declaration_decides_where_a_joint_is_too_fast() -> None:
    time = np.arange(50) * 0.1
    found = unwrap(motion(time, wrapped(28.0 * time, -np.pi)), None, declared=True)
    np.testing.assert_allclose(found.position, 28.0 * time, atol=1e-9)


def test_an_encoder_behind_a_gear_wraps_at_its_own_turn() -> None:
    time = np.arange(400) * 0.01
    truth = 0.8 * np.sin(time)
    turn = TURN / 10
    found = unwrap(motion(time, np.mod(truth, turn)), None, turn)
    np.testing.assert_allclose(found.position, truth, atol=1e-9)
