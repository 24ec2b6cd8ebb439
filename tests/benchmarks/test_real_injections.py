"""Errors injected into recordings change exactly the stated quantity and nothing else."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.formats.recording import JointSeries

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "concealed"))

import injections
from injections import Recorded

START = 1_760_000_000_000_000_000
JOINTS = ("pan", "lift")


def _series(topic: str, rate: float, seed: int, *, effort: bool) -> JointSeries:
    rng = np.random.default_rng(seed)
    count = round(2.0 * rate)
    stamp = START + np.round(np.arange(count) / rate * 1e9).astype(np.int64)
    values = rng.uniform(-1.0, 1.0, (3, count, 2))
    return JointSeries(
        topic, JOINTS, stamp, stamp.copy(), values[0], values[1], values[2] if effort else None
    )


@pytest.fixture
def recorded() -> Recorded:
    """A recording of 2 s and two joints, states at 100 Hz and commands at 50 Hz."""
    state = _series("/joint_states", 100.0, 1, effort=True)
    command = _series("/joint_commands", 50.0, 2, effort=True)
    return Recorded(state, command, {"role": "fit"})


def _assert_same_arrays(one: JointSeries, other: JointSeries, *but: str) -> None:
    """Check that all arrays except those named in ``but`` are bitwise equal."""
    for name in ("stamp", "log_time", "position", "velocity", "effort"):
        if name not in but:
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name


def test_late_states_shift_state_stamps_by_exactly_the_delay(recorded: Recorded) -> None:
    late = injections.late_states(recorded, 0.0123)
    assert np.unique(late.state.stamp - recorded.state.stamp).tolist() == [12_300_000]
    assert np.unique(late.state.log_time - recorded.state.log_time).tolist() == [12_300_000]
    _assert_same_arrays(late.state, recorded.state, "stamp", "log_time")
    _assert_same_arrays(late.command, recorded.command)


def test_a_late_drive_shifts_command_stamps_back_by_the_delay(recorded: Recorded) -> None:
    late = injections.late_drive(recorded, 0.02)
    assert np.unique(late.command.stamp - recorded.command.stamp).tolist() == [-20_000_000]
    _assert_same_arrays(late.command, recorded.command, "stamp", "log_time")
    _assert_same_arrays(late.state, recorded.state)


def test_a_late_drive_of_one_joint_leaves_the_other_joint_unchanged(recorded: Recorded) -> None:
    late = injections.late_drive_of(recorded, "lift", 3)
    assert len(late.command.stamp) == len(recorded.command.stamp) - 3
    before, after = recorded.command.position, late.command.position
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after[:, 0], before[:-3, 0])
    np.testing.assert_array_equal(after[:, 1], before[3:, 1])
    np.testing.assert_array_equal(late.command.stamp, recorded.command.stamp[:-3])
    _assert_same_arrays(late.state, recorded.state)


@pytest.mark.parametrize("drift", [0.01, -0.004])
def test_clock_drift_scales_the_state_stamps(recorded: Recorded, drift: float) -> None:
    drifted = injections.drifting_clock(recorded, drift)
    shown = (drifted.state.stamp - START) * 1e-9
    taken = (recorded.state.stamp - START) * 1e-9
    assert shown * (1.0 - drift) == pytest.approx(taken, abs=1e-9)
    _assert_same_arrays(drifted.state, recorded.state, "stamp", "log_time")
    _assert_same_arrays(drifted.command, recorded.command)


READINGS: dict[str, tuple[Callable[[Recorded], Recorded], Callable[..., object]]] = {
    "scale": (
        lambda r: injections.scaled_encoder(r, "lift", 0.05),
        lambda q, v: (1.05 * q, 1.05 * v),
    ),
    "bias": (lambda r: injections.biased_encoder(r, "lift", -0.03), lambda q, v: (q - 0.03, v)),
    "eccentric": (
        lambda r: injections.bent_encoder(r, "lift", 0.04, 0.7),
        lambda q, v: (q + 0.04 * np.sin(q + 0.7), v * (1.0 + 0.04 * np.cos(q + 0.7))),
    ),
    "quantized": (
        lambda r: injections.quantized_encoder(r, "lift", 0.25),
        lambda q, v: (np.round(q / 0.25) * 0.25, v),
    ),
}


@pytest.mark.parametrize("kind", READINGS)
def test_an_encoder_error_follows_its_equation_on_one_joint_only(
    recorded: Recorded, kind: str
) -> None:
    inject, equation = READINGS[kind]
    changed = inject(recorded)
    assert recorded.state.position is not None
    assert recorded.state.velocity is not None
    assert changed.state.position is not None
    assert changed.state.velocity is not None
    q, v = equation(recorded.state.position[:, 1], recorded.state.velocity[:, 1])
    assert changed.state.position[:, 1] == pytest.approx(q, abs=1e-15)
    assert changed.state.velocity[:, 1] == pytest.approx(v, abs=1e-15)
    assert not np.array_equal(changed.state.position[:, 1], recorded.state.position[:, 1])
    np.testing.assert_array_equal(changed.state.position[:, 0], recorded.state.position[:, 0])
    _assert_same_arrays(changed.state, recorded.state, "position", "velocity")
    _assert_same_arrays(changed.command, recorded.command)


def test_dropped_states_keep_the_first_and_last_state(recorded: Recorded) -> None:
    thin = injections.dropped_states(recorded, 0.4, np.random.default_rng(3))
    rows = np.flatnonzero(np.isin(recorded.state.stamp, thin.state.stamp))
    assert 0.5 * 200 < len(rows) < 0.7 * 200
    assert rows[[0, -1]].tolist() == [0, 199]
    assert recorded.state.position is not None
    assert thin.state.position is not None
    np.testing.assert_array_equal(thin.state.position, recorded.state.position[rows])
    _assert_same_arrays(thin.command, recorded.command)


def test_a_filtered_velocity_has_the_step_response_of_its_time_constant(recorded: Recorded) -> None:
    step = np.zeros((200, 2))
    step[50:, 1] = 1.0
    stepped = replace(recorded, state=replace(recorded.state, velocity=step))
    slow = injections.filtered_velocity(stepped, "lift", 0.05).state.velocity
    assert slow is not None
    assert not slow[:50].any()
    # Five samples of 10 ms are one time constant.
    assert slow[54, 1] == pytest.approx(1.0 - np.exp(-1.0), rel=1e-9)
    assert not slow[:, 0].any()


def test_an_echoed_effort_equals_the_latest_command(recorded: Recorded) -> None:
    effort = injections.echoed_effort(recorded).state.effort
    assert recorded.command.effort is not None
    assert effort is not None
    np.testing.assert_array_equal(effort[::2], recorded.command.effort)
    np.testing.assert_array_equal(effort[1::2], recorded.command.effort)


def test_an_effort_error_applies_scale_and_bias(recorded: Recorded) -> None:
    changed = injections.misread_effort(recorded, "pan", 0.2, -0.5)
    assert recorded.state.effort is not None
    assert changed.state.effort is not None
    np.testing.assert_array_equal(
        changed.state.effort[:, 0], 1.2 * recorded.state.effort[:, 0] - 0.5
    )
    np.testing.assert_array_equal(changed.state.effort[:, 1], recorded.state.effort[:, 1])


NEUTRAL: dict[str, Callable[[Recorded], Recorded]] = {
    "late_states": lambda r: injections.late_states(r, 0.0),
    "late_drive": lambda r: injections.late_drive(r, 0.0),
    "late_drive_of": lambda r: injections.late_drive_of(r, "pan", 0),
    "drifting_clock": lambda r: injections.drifting_clock(r, 0.0),
    "scaled_encoder": lambda r: injections.scaled_encoder(r, "pan", 0.0),
    "biased_encoder": lambda r: injections.biased_encoder(r, "pan", 0.0),
    "bent_encoder": lambda r: injections.bent_encoder(r, "pan", 0.0, 1.0),
    "dropped_states": lambda r: injections.dropped_states(r, 0.0, np.random.default_rng(1)),
    "filtered_velocity": lambda r: injections.filtered_velocity(r, "pan", 1e-9),
    "misread_effort": lambda r: injections.misread_effort(r, "pan", 0.0, 0.0),
    "cut": lambda r: injections.cut(r, 0.0, 10.0),
    "of_joints": lambda r: injections.of_joints(r, JOINTS),
}


@pytest.mark.parametrize("name", NEUTRAL)
def test_a_neutral_injection_leaves_the_written_file_bitwise_identical(
    recorded: Recorded, name: str, tmp_path: Path
) -> None:
    for file, each in (("before", recorded), ("after", NEUTRAL[name](recorded))):
        write_recording(tmp_path / f"{file}.mcap", [each.state, each.command], each.metadata)
    before, after = (read_recording(tmp_path / f"{f}.mcap") for f in ("before", "after"))
    for role in ("state", "command"):
        _assert_same_arrays(after.series[role], before.series[role])
    assert (tmp_path / "after.mcap").read_bytes() == (tmp_path / "before.mcap").read_bytes()


def test_a_cut_keeps_only_the_given_interval(recorded: Recorded) -> None:
    part = injections.cut(recorded, 0.5, 1.0)
    for series in (part.state, part.command):
        time = (series.stamp - START) * 1e-9
        assert time.min() >= 0.5
        assert time.max() < 1.5
    assert len(part.state.stamp) == 100
