"""Detection of what logged velocities and efforts are: measured, derived or demanded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recorded_pendulum import Reality, cell

from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.signal_meaning import RecordedSignals, determine_signals
from pytest_twin.diagnosis.signal_meaning.effort import (
    JointLog,
    LawFit,
    effort_fact,
    equals_command,
)
from pytest_twin.diagnosis.signal_meaning.velocity import velocity_fact, velocity_signal
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.loaded_model import find_model, load_model

PERIOD = 0.004
TIME = np.arange(0.0, 4.0, PERIOD)
RATE = np.array([3.0, 7.0, 13.0])
SIZE = np.array([0.4, 0.1, 0.03])


def position(lag: float = 0.0) -> np.ndarray:
    return (SIZE[:, None] * np.sin(RATE[:, None] * (TIME - lag))).sum(axis=0)


def speed(lag: float = 0.0) -> np.ndarray:
    return ((SIZE * RATE)[:, None] * np.cos(RATE[:, None] * (TIME - lag))).sum(axis=0)


def noisy(values: np.ndarray, deviation: float, seed: int = 1) -> np.ndarray:
    return values + deviation * np.random.default_rng(seed).standard_normal(len(values))


def test_the_velocity_of_a_sensor_has_no_lag_to_the_position() -> None:
    fact = velocity_fact(TIME, noisy(position(), 1e-4), noisy(speed(), 2e-3, 2))
    assert fact.value == "sensor"
    assert abs(fact.numbers["lag"][0]) < 2e-4


@pytest.mark.parametrize("lag", [0.003, -0.003, 0.02])
def test_the_lag_of_a_late_velocity_is_found(lag: float) -> None:
    fact = velocity_fact(TIME, noisy(position(), 1e-4), noisy(speed(lag), 2e-3, 2))
    assert fact.value == "late"
    assert fact.numbers["lag"][0] == pytest.approx(lag, abs=max(3e-4, 0.05 * abs(lag)))


def test_backward_differences_of_positions_lag_by_half_a_sample() -> None:
    q = noisy(position(), 1e-4)
    found = velocity_signal(TIME, q, np.diff(q, prepend=q[0]) / PERIOD)
    assert found is not None
    assert found.kind == "differenced"
    assert found.lag == pytest.approx(PERIOD / 2, rel=0.02)


def test_central_differences_of_positions_have_no_lag() -> None:
    q = noisy(position(), 1e-4)
    found = velocity_signal(TIME, q, np.gradient(q, TIME))
    assert found is not None
    assert (found.kind, found.lag) == ("differenced", 0.0)


def test_the_bandwidth_of_a_filter_on_position_differences_is_found() -> None:
    q = noisy(position(), 1e-4)
    v = np.diff(q, prepend=q[0]) / PERIOD
    keep = np.exp(-PERIOD / 0.01)
    for k in range(1, len(v)):
        v[k] = keep * v[k - 1] + (1.0 - keep) * v[k]
    found = velocity_signal(TIME, q, v)
    assert found is not None
    assert found.kind == "filtered"
    assert found.bandwidth == pytest.approx(1.0 / (2.0 * np.pi * 0.01), rel=0.02)


def test_a_joint_at_rest_does_not_determine_the_source_of_its_velocity() -> None:
    assert velocity_fact(TIME, np.zeros(len(TIME)), np.zeros(len(TIME))).value is None


def settled(folder: Path, reality: Reality) -> tuple[RecordedSignals, tuple]:
    model, recordings = cell(folder / "cell", reality)
    loaded = load_model(find_model(model))
    trials = read_trials(recordings, [], loaded.topics, loaded.realization.structure)
    found = determine_signals(ModelSetup.of(loaded.realization, None, 1), trials)
    return found, found.apply(trials).fit


@pytest.mark.parametrize("hidden", [{"lag": 0.012}, {"play": 0.01}], ids=["lag", "dead zone"])
def test_an_effort_without_drive_dynamics_is_the_demanded_effort(
    tmp_path: Path, hidden: dict[str, float]
) -> None:
    found, used = settled(tmp_path, Reality(effort="demanded", velocity="sensor", **hidden))
    assert found.effort["j1"].value == "demanded", found.effort["j1"].evidence
    assert used[0].effort is None


@pytest.mark.parametrize("hidden", [{"lag": 0.012}, {"play": 0.01}], ids=["lag", "dead zone"])
def test_an_effort_with_drive_dynamics_is_measured(
    tmp_path: Path, hidden: dict[str, float]
) -> None:
    found, used = settled(tmp_path, Reality(effort="measured", velocity="sensor", **hidden))
    assert found.effort["j1"].value == "measured", found.effort["j1"].evidence
    assert used[0].effort is not None


def test_with_an_ideal_drive_demanded_and_measured_effort_cannot_be_distinguished(
    tmp_path: Path,
) -> None:
    found, used = settled(tmp_path, Reality(effort="measured", velocity="sensor"))
    assert found.effort["j1"].value is None
    assert used[0].effort is not None


def test_an_effort_older_than_its_stamp_is_not_used_as_a_measurement(tmp_path: Path) -> None:
    reality = Reality(effort="measured", effort_late=0.003, velocity="sensor")
    found, used = settled(tmp_path, reality)
    assert found.effort["j1"].numbers["lag"][0] == pytest.approx(0.003, abs=5e-4)
    assert used[0].effort is None


def test_a_velocity_derived_from_positions_is_not_used_as_a_measurement(tmp_path: Path) -> None:
    found, used = settled(tmp_path, Reality(velocity="differenced", filtered=0.01))
    assert found.velocity["j1"].value == "filtered"
    assert used[0].velocity is None


def test_an_effort_lag_is_reported_only_if_every_possible_setpoint_needs_it() -> None:
    needs, does_not = LawFit(0.0100, 0.002, 0.05), LawFit(0.0105, 0.0, 0.0105)
    assert effort_fact(1.0, [needs, does_not], [], PERIOD).numbers["lag"][0] == 0.0
    assert effort_fact(1.0, [needs], [], PERIOD).numbers["lag"][0] == 0.002


def test_efforts_that_no_servo_law_explains_have_no_determined_source() -> None:
    fact = effort_fact(1.0, [LawFit(0.5, 0.0, 0.5)], [LawFit(0.6, 0.0, 0.6)], PERIOD)
    assert fact.value is None
    assert "does not explain" in fact.evidence


@pytest.mark.parametrize(
    ("gain", "offset", "lag", "repeats"),
    [
        (1.0, 0.0, 0.0, True),
        (0.86, 0.0, 0.0, False),
        (1.0, 0.2, 0.0, False),
        (1.0, 0.0, 0.02, False),
    ],
    ids=["equal", "other gain", "offset", "lag"],
)
def test_efforts_that_repeat_the_effort_commands_are_detected(
    gain: float, offset: float, lag: float, repeats: bool
) -> None:
    grid = np.arange(TIME[0], TIME[-1], PERIOD / 20)
    sent = np.interp(grid, TIME, position())
    effort = noisy(gain * np.interp(TIME - lag, grid, sent) + offset, 5e-3)
    assert equals_command(JointLog(TIME, effort, grid, sent, None)) is repeats
