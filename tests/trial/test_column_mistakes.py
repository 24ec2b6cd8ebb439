"""Columns that were recorded twice, exchanged or reversed: said by all that read the recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_stream_checks import COUNT, RATE, commanded, measured

from pytest_twin import cli
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import make_trials, recordings_at
from pytest_twin.twin import DEFAULT_TOPICS

pytestmark = pytest.mark.usefixtures("commands_in_process")
HEAD = "time,hip.position,knee.position,hip.velocity,knee.velocity,hip.command,knee.command"


def log(folder: Path, position: np.ndarray, velocity: np.ndarray, command: np.ndarray) -> Path:
    time = np.arange(len(position)) / RATE
    path = folder / "log.csv"
    table = np.column_stack([time, position, velocity, command])
    np.savetxt(path, table, "%.9g", ",", header=HEAD, comments="")
    return path


def notes_of(path: Path) -> str:
    options = RecordingOptions(command_mode="position")
    (recording,) = recordings_at(path, DEFAULT_TOPICS, options)
    return "\n".join(note for t in make_trials(recording, None, options) for note in t.notes)


COMMAND = commanded()
POSITION = measured(COMMAND)
VELOCITY = np.gradient(POSITION, 1.0 / RATE, axis=0)


@pytest.mark.parametrize(
    ("position", "velocity", "command", "words"),
    [
        (POSITION[:, ::-1], VELOCITY[:, ::-1], COMMAND,
         "the position of 'hip' follows the command of 'knee'"),
        (POSITION, VELOCITY[:, ::-1], COMMAND,
         "the position of 'hip' follows the velocity of 'knee'"),
        (POSITION * [1, -1], VELOCITY * [1, -1], COMMAND,
         "the position of 'knee' runs against its command"),
        (POSITION, VELOCITY * [-1, 1], COMMAND,
         "the position of 'hip' runs against its velocity"),
        (POSITION, VELOCITY * [1, 30.0 / np.pi], COMMAND,
         "the position of 'knee' moves 0.105 times as far as its velocity says"),
        (POSITION[:, [0, 0]], VELOCITY, COMMAND,
         "the positions of hip and knee are the same numbers in every message"),
        (POSITION, VELOCITY, COMMAND[:, [0, 0]],
         "the commands of hip and knee are the same numbers in every message"),
    ],
)  # fmt: skip
def test_a_mistaken_column_is_named(
    tmp_path: Path, position: np.ndarray, velocity: np.ndarray, command: np.ndarray, words: str
) -> None:
    assert words in notes_of(log(tmp_path, position, velocity, command))


@pytest.mark.parametrize(
    ("position", "command", "words"),
    [
        (POSITION / [1.0, 2.0 * np.pi], COMMAND, "'knee' follows 0.1"),
        (POSITION - POSITION[0], COMMAND, "'knee' is 0.6"),
        (POSITION, np.gradient(COMMAND, axis=0), "'knee' hardly follows its position command"),
    ],
)
def test_commands_that_mean_something_else_are_named(
    tmp_path: Path, position: np.ndarray, command: np.ndarray, words: str
) -> None:
    """Revolutions, positions from where the arm was switched on, and increments."""
    assert f"the position of {words}" in notes_of(log(tmp_path, position, VELOCITY, command))


def test_show_names_it_without_a_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = log(tmp_path, POSITION * [1, -1], VELOCITY * [1, -1], COMMAND)
    assert cli.main(["show", str(path), "--command-mode", "position"]) == 0
    assert "the position of 'knee' runs against its command" in capsys.readouterr().out


def test_nothing_is_said_of_right_columns(tmp_path: Path) -> None:
    notes = notes_of(log(tmp_path, POSITION, VELOCITY, COMMAND))
    assert "follows" not in notes
    assert "runs against" not in notes
    assert "the same numbers" not in notes


def test_nothing_is_said_where_the_columns_do_not_show_it(tmp_path: Path) -> None:
    """Joints that move alike, a joint at rest, and a drive far beyond its bandwidth."""
    time = np.arange(COUNT) / RATE
    alike = np.column_stack([np.sin(time), np.sin(time)])
    rng = np.random.default_rng(0)
    noisy = alike + 1e-4 * rng.standard_normal(alike.shape)
    beyond = np.column_stack([np.sin(40.0 * time), np.sin(30.0 * time)])
    for position, command in (
        (noisy[:, ::-1], alike),
        (1e-4 * rng.standard_normal(alike.shape), alike),
        (-0.1 * beyond + 1e-4 * rng.standard_normal(alike.shape), beyond),
    ):
        velocity = np.gradient(position, 1.0 / RATE, axis=0)
        notes = notes_of(log(tmp_path, position, velocity, command))
        assert "follows" not in notes
        assert "runs against" not in notes
