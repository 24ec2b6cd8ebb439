"""Conversion of motor-side and joint-side signals to joint positions and joint efforts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arms import simulated_effort, true_arm, write_model, write_recording
from fourier_motion import needed_effort

from pytest_twin.errors import RecordingError
from pytest_twin.identification.effort.amounts import without_amounts
from pytest_twin.identification.measured_recordings import (
    MeasuredRecording,
    MeasuredRecordings,
    may_be_an_amount,
    read_measured,
    velocity_notes,
)
from pytest_twin.realization import load
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.signals import Signals
from pytest_twin.twin import DEFAULT_TOPICS, load_twin


def measured_signals(
    folder: Path, position: np.ndarray, effort: np.ndarray, signals: dict
) -> MeasuredRecording:
    path = write_recording(folder / "run.csv", np.arange(len(position)) / 100.0, position, effort)
    robot = load(write_model(folder))
    (one,) = read_measured(path, robot, DEFAULT_TOPICS, NO_OPTIONS, Signals.from_json(signals))
    return one


def test_motor_signals_are_converted_to_joint_signals(tmp_path: Path) -> None:
    _, q, effort = simulated_effort(true_arm(tmp_path), 1, seconds=2.0, rate=100.0)
    # The elbow motor moves with both joints, so its torque acts on both (virtual work).
    motor_q = np.column_stack([50.0 * q[:, 0], -30.0 * (q[:, 1] - 0.2 + q[:, 0])])
    motor_t = np.column_stack([(effort[:, 0] - effort[:, 1]) / 50.0, effort[:, 1] / -30.0])
    one = measured_signals(
        tmp_path, motor_q, motor_t,
        {
            "default": {"position": {"side": "motor"}, "effort": {"side": "motor"}},
            "joints": {
                "shoulder": {"gear": 50.0},
                "elbow": {"gear": -30.0, "zero": 0.2, "shared_with": {"joint": "shoulder"}},
            },
        },
    )  # fmt: skip
    np.testing.assert_allclose(one.position, q, atol=1e-7)
    np.testing.assert_allclose(one.effort, effort, atol=1e-6)


def test_degrees_are_converted_to_radians(tmp_path: Path) -> None:
    _, q, effort = simulated_effort(true_arm(tmp_path), 1, seconds=2.0, rate=100.0)
    one = measured_signals(
        tmp_path, np.degrees(q), effort, {"default": {"position": {"unit": "deg"}}}
    )
    np.testing.assert_allclose(one.position, q, atol=1e-7)


def test_a_current_is_converted_to_torque_only_with_a_torque_constant(tmp_path: Path) -> None:
    _, q, effort = simulated_effort(true_arm(tmp_path), 1, seconds=2.0, rate=100.0)
    current = {"default": {"effort": {"quantity": "current"}}}
    one = measured_signals(tmp_path, q, effort, current)
    assert one.unscaled.all()
    assert "effort is a current of unknown torque constant" in one.notes[0]
    known = {"default": {"effort": {"quantity": "current", "constant": 0.5}}}
    one = measured_signals(tmp_path, q, 2.0 * effort, known)
    np.testing.assert_allclose(one.effort, effort, atol=1e-6)
    assert not one.unscaled.any()


def test_an_effort_without_sign_is_not_used(tmp_path: Path) -> None:
    _, q, effort = simulated_effort(
        true_arm(tmp_path), 1, seconds=10.0, rate=100.0, about=np.pi / 2
    )
    one = measured_signals(tmp_path, q, np.abs(effort), {})
    assert may_be_an_amount(one.effort[:, 0])
    (left,) = without_amounts(load(write_model(tmp_path)), MeasuredRecordings((one,), ())).fit
    assert np.isnan(left.effort).all()
    assert "effort never changes its sign: an amount and no torque" in left.notes[0]


def test_a_torque_that_a_weight_keeps_positive_is_a_torque(tmp_path: Path) -> None:
    # The arm swings on one side of its lowest position, without friction.
    time = np.arange(0.0, 20.0, 0.01)
    swing = 0.5 * (1.0 - np.cos(0.8 * time)) + 0.05
    q = np.column_stack([np.pi / 2 + swing, 0.2 * np.sin(0.5 * time)])
    v, a = (np.gradient(q, time, axis=0), np.gradient(np.gradient(q, time, axis=0), time, axis=0))
    real = true_arm(tmp_path, damping=0.0, friction=0.0, elbow=0.0)
    effort = needed_effort(real.model, q, v, a)
    effort[:, 0] *= np.sign(effort[:, 0].mean())
    positive = np.maximum(effort, 0.0)
    one = measured_signals(tmp_path, q, positive, {})
    assert may_be_an_amount(one.effort[:, 0])
    (left,) = without_amounts(load(write_model(tmp_path)), MeasuredRecordings((one,), ())).fit
    assert np.isfinite(left.effort[:, 0]).all()


def test_an_effort_that_is_always_zero_is_treated_as_unknown(tmp_path: Path) -> None:
    _, q, effort = simulated_effort(true_arm(tmp_path), 1, seconds=2.0, rate=100.0)
    effort[:, 1] = 0.0
    one = measured_signals(tmp_path, q, effort, {})
    assert np.isnan(one.effort[:, 1]).all()
    assert "elbow: effort reads 0 throughout: no sensor, its effort is unknown" in one.notes


def test_a_gap_divides_a_recording_into_two(tmp_path: Path) -> None:
    time, q, effort = simulated_effort(true_arm(tmp_path), 1, seconds=4.0, rate=100.0)
    time[200:] += 1.0
    path = write_recording(tmp_path / "run.csv", time, q, effort)
    parts = read_measured(path, load(write_model(tmp_path)), DEFAULT_TOPICS, NO_OPTIONS, Signals())
    assert [len(part.time) for part in parts] == [200, 200]
    assert parts[1].start == pytest.approx(3.0)


def test_too_few_states_are_refused(tmp_path: Path) -> None:
    _, q, effort = simulated_effort(true_arm(tmp_path), 1, seconds=0.2, rate=100.0)
    with pytest.raises(RecordingError, match=r"too few states to differentiate \(got 20; expected"):
        measured_signals(tmp_path, q, effort, {})


def test_signals_are_read_from_the_twin_file(tmp_path: Path) -> None:
    write_model(tmp_path)
    text = (
        "model: model.xml\nsignals:\n  default: {effort: {quantity: current, rate: 500}}\n"
        "  joints: {elbow: {gear: 100, effort: {constant: 0.2}}}\n"
    )
    (tmp_path / "twin.yaml").write_text(text)
    signals = load_twin(tmp_path / "twin.yaml").recordings.signals
    assert signals.of("elbow").effort.quantity == "current"
    assert signals.of("elbow").effort.constant == 0.2
    assert signals.of("shoulder").effort.constant is None
    assert signals.of("elbow").gear == 100.0


TIME = np.arange(0.0, 10.0, 0.01)
ANGLE = 0.4 * np.sin(1.3 * TIME)[:, None] + np.array([0.0, 1.0])
SPEED = np.gradient(ANGLE, TIME, axis=0)


def test_a_missing_velocity_is_mentioned() -> None:
    words = "no velocity is recorded: positions are differentiated"
    assert velocity_notes(("a", "b"), TIME, ANGLE, None) == [words]
    assert velocity_notes(("a", "b"), TIME, ANGLE, np.zeros_like(ANGLE)) == [words]
    lost = SPEED.copy()
    lost[:, 1] = np.nan
    assert velocity_notes(("a", "b"), TIME, ANGLE, lost) == [words.replace("y is", "y of b is")]


def test_a_velocity_that_agrees_with_noisy_positions_is_not_mentioned() -> None:
    noisy = ANGLE + 1e-3 * np.random.default_rng(0).standard_normal(ANGLE.shape)
    assert velocity_notes(("a", "b"), TIME, noisy, SPEED) == []


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (180.0 / np.pi, "is 57.3 times the change of the positions: it seems to be in deg/s"),
        (30.0 / np.pi, "it seems to be in revolutions per minute"),
        (-1.0, "is -1 times the change of the positions: its unit, side or sign is wrong"),
    ],
)
def test_a_velocity_in_another_unit_is_mentioned(factor: float, words: str) -> None:
    (note,) = velocity_notes(("a", "b"), TIME, ANGLE, SPEED * np.array([1.0, factor]))
    assert note.startswith("b: the recorded velocity")
    assert words in note


def test_a_velocity_of_another_joint_is_mentioned() -> None:
    other = SPEED.copy()
    other[:, 0] = np.cos(7.0 * TIME)
    (note,) = velocity_notes(("a", "b"), TIME, ANGLE, other)
    assert note == "a: the recorded velocity does not follow the positions; it is not used"


def test_missing_velocities_of_a_recording_are_noted(tmp_path: Path) -> None:
    _, q, effort = simulated_effort(true_arm(tmp_path), 1, seconds=2.0, rate=100.0)
    one = measured_signals(tmp_path, q, effort, {})
    assert "no velocity is recorded: positions are differentiated" in one.notes


def test_wrapped_angles_and_repeated_states_are_those_of_the_arm(tmp_path: Path) -> None:
    _, q, effort = simulated_effort(true_arm(tmp_path), 1, seconds=2.0, rate=100.0)
    # The arm has no ranges, so that a constant turns its base.
    truth = q + np.linspace(0.0, 9.0, len(q))[:, None]
    wrapped = np.mod(truth + np.pi, 2.0 * np.pi) - np.pi
    rows = np.repeat(np.arange(len(q)), 3)
    one = measured_signals(tmp_path, wrapped[rows], effort[rows], {})
    np.testing.assert_allclose(one.position - one.position[0], truth - truth[0], atol=1e-6)
    notes = " ".join(one.notes)
    assert "each about 3 times" in notes
    assert "shoulder: positions step by 6.283 rad" in notes
