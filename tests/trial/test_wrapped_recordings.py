"""Positions and commands that a recording has within one turn are those of the arm again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foreign_logs import TRUE_RMS, changed_positions, recorded, replayed, trial_of, write

from pytest_twin.formats.recording import JointSeries
from pytest_twin.signals import Signals

TURN = 2.0 * np.pi


def within_turn(series: JointSeries, start: float) -> JointSeries:
    assert series.position is not None
    position = series.position.copy()
    position[:, 0] = start + np.mod(position[:, 0] - start, TURN)
    return changed_positions(series, position)


@pytest.mark.parametrize("roles", [("state",), ("command",), ("state", "command")])
@pytest.mark.parametrize("start", [-np.pi, 0.0])
def test_wrapped_recordings_are_unwrapped_with_a_note(
    tmp_path: Path, roles: tuple[str, ...], start: float
) -> None:
    truth = recorded()
    series = {
        role: within_turn(one, start) if role in roles else one for role, one in truth.items()
    }
    trial = trial_of(write(tmp_path / "log.mcap", series))
    state, command = truth["state"].position, truth["command"].position
    assert state is not None
    assert command is not None
    turns = np.rint((trial.position - state)[0] / TURN)
    np.testing.assert_allclose(trial.position, state + TURN * turns, atol=1e-9)
    np.testing.assert_allclose(trial.command, command + TURN * turns, atol=1e-9)
    noted = " ".join(trial.notes)
    assert ("j1: positions step by 6.283 rad" in noted) == ("state" in roles)
    assert ("j1: commands step by 6.283 rad" in noted) == ("command" in roles)


def test_a_declared_angle_is_not_unwrapped(tmp_path: Path) -> None:
    series = {role: within_turn(one, -np.pi) for role, one in recorded().items()}
    signals = Signals.from_json({"default": {"position": {"wrapped": False}}})
    trial = trial_of(write(tmp_path / "log.mcap", series), signals=signals)
    np.testing.assert_array_equal(trial.position, series["state"].position)


@pytest.mark.usefixtures("commands_in_process")
def test_the_replay_of_a_wrapped_recording_has_the_error_of_the_unwrapped_one(
    tmp_path: Path,
) -> None:
    series = {role: within_turn(one, 0.0) for role, one in recorded().items()}
    rms, _ = replayed(write(tmp_path / "log.mcap", series), tmp_path)
    assert rms == pytest.approx(TRUE_RMS, abs=1e-5)
