"""States that a node publishes again are one sample; what looks like it is kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_logs import recorded, trial_of, write

from pytest_twin.trial.repeated_states import own_samples


def stamps(count: int, rate: float) -> np.ndarray:
    return np.rint(np.arange(count) / rate * 1e9).astype(np.int64)


@pytest.mark.parametrize("repeats", [2.0, 2.5, 4.0, 10.0])
def test_each_sample_counts_once(repeats: float) -> None:
    samples = np.sin(0.02 * np.arange(300))[:, None]
    of = (np.arange(int(300 * repeats)) / repeats).astype(int)
    found = own_samples(stamps(len(of), 100.0 * repeats), {"position": samples[of]})
    assert found.repeats == pytest.approx(repeats, rel=0.05)
    np.testing.assert_array_equal(samples[of][found.rows], samples[: len(found.rows)])


def test_samples_at_rest_are_kept() -> None:
    samples = np.concatenate([np.sin(0.02 * np.arange(100)), np.full(100, 0.3)])[:, None]
    of = np.arange(800) // 4
    found = own_samples(stamps(800, 400.0), {"position": samples[of]})
    assert len(found.rows) == pytest.approx(200, abs=2)


@pytest.mark.parametrize(
    "position",
    [
        np.sin(0.02 * np.arange(2000)),
        0.001 * np.round(np.sin(0.002 * np.arange(2000)) / 0.001),
        0.001 * np.round(0.0002 * np.arange(2000) / 0.001),
        np.where(np.arange(2000) < 1000, 0.0, np.sin(0.02 * np.arange(2000))),
        np.zeros(2000),
    ],
)
def test_a_slow_encoder_and_a_joint_at_rest_are_not_repeated(position: np.ndarray) -> None:
    found = own_samples(stamps(2000, 1000.0), {"position": position[:, None]})
    assert len(found.rows) == 2000


def test_the_same_message_twice_is_one_sample() -> None:
    position = np.repeat(np.sin(0.02 * np.arange(100)), 2)[:, None]
    found = own_samples(np.repeat(stamps(100, 100.0), 2), {"position": position})
    np.testing.assert_array_equal(found.rows, np.arange(0, 200, 2))


def test_a_trial_of_repeated_states_has_the_samples_with_a_note(tmp_path: Path) -> None:
    series = dict(recorded())
    state = series["state"]
    assert state.position is not None
    rows = np.repeat(np.arange(len(state.stamp)), 5)
    late = np.tile(np.arange(5) * 2_000_000, len(state.stamp))
    series["state"] = replace(
        state, stamp=state.stamp[rows] + late, log_time=state.log_time[rows] + late,
        position=state.position[rows], velocity=None, effort=None,
    )  # fmt: skip
    trial = trial_of(write(tmp_path / "log.mcap", series))
    assert len(trial.time) == len(state.stamp)
    np.testing.assert_allclose(trial.position, state.position)
    assert "3000 messages repeat 600 samples, each about 5 times" in " ".join(trial.notes)
