"""Mistakes in position commands are reported from how the positions follow them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pytest_twin.identification.simulation.command_mistakes import command_mistakes
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import Trial, make_trials, recordings_at
from pytest_twin.twin import DEFAULT_TOPICS


def trials(folder: Path, factor: float, noise: float = 1e-3) -> list[Trial]:
    """A joint whose position is ``factor`` times a late and smoothed command, about 0.5 rad."""
    time = np.arange(0.0, 10.0, 0.02)
    random = np.random.default_rng(3)
    command = 0.4 * np.sin(1.5 * time) + 0.2 * np.sin(4.0 * time)
    late = np.interp(time - 0.08, time, command)
    position = 0.5 + factor * late + noise * random.standard_normal(len(time))
    path = folder / "run.csv"
    table = np.column_stack([time, position, command])
    head = "time,knee.position,knee.command"
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=head, comments="")
    options = RecordingOptions(command_mode="position", units="rad")
    return make_trials(recordings_at(path, DEFAULT_TOPICS, options)[0], None, options)


@pytest.mark.parametrize("factor", [1.0, 0.7, 1.5])
def test_a_position_that_follows_its_command_causes_no_suspicion(
    tmp_path: Path, factor: float
) -> None:
    assert command_mistakes(trials(tmp_path, factor)) == []


def test_a_joint_that_does_not_follow_causes_no_suspicion(tmp_path: Path) -> None:
    assert command_mistakes(trials(tmp_path, 0.05, noise=0.3)) == []
    assert command_mistakes(trials(tmp_path, 0.0, noise=1e-5)) == []


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (-1.0, "knee: the position moves against its command (correlation -"),
        (30.0, "another unit, or the other side of a gear"),
    ],
)
def test_a_wrong_sign_or_unit_is_reported_and_fatal(
    tmp_path: Path, factor: float, words: str
) -> None:
    (mistake,) = command_mistakes(trials(tmp_path, factor, noise=1e-4))
    assert words in mistake.what
    assert "knee" in mistake.mend
    assert mistake.is_fatal
