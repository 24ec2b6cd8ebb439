"""Whether a recording repeats the motion of another one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pytest_twin.formats.recording import TOPICS
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import Trial, make_trials, recordings_at
from pytest_twin.trial.repeated import is_repeated


def trial(folder: Path, name: str, *, phase: float, seconds: float, jitter: float = 0.0) -> Trial:
    """A sine of 1 Hz, commanded at 200 Hz and followed 20 ms later with noise."""
    rng = np.random.default_rng(len(name))
    time = np.arange(0.0, seconds, 0.005)
    time[1:] += jitter * rng.uniform(-1.0, 1.0, len(time) - 1)
    sent, moved = (0.5 * np.sin(2.0 * np.pi * (time - late) + phase) for late in (0.0, 0.02))
    moved = moved + 1e-3 * rng.standard_normal(len(time))
    rows = "".join(f"{t:.6f},{q:.6f},{c:.6f}\n" for t, q, c in zip(time, moved, sent, strict=True))
    path = folder / f"{name}.csv"
    path.write_text("time,a.position,a.command\n" + rows)
    (recording,) = recordings_at(path, TOPICS)
    (made,) = make_trials(recording, None, RecordingOptions(command_mode="position"))
    return made


@pytest.mark.parametrize(
    ("phase", "seconds", "is_same"),
    [(0.0, 3.0, True), (0.2, 3.0, False), (0.0, 1.5, False)],
    ids=["same commands", "other phase", "half as long"],
)
def test_a_motion_is_repeated_by_its_commands(
    tmp_path: Path, phase: float, seconds: float, is_same: bool
) -> None:
    first = trial(tmp_path, "first", phase=0.0, seconds=3.0, jitter=0.001)
    other = trial(tmp_path, "other", phase=phase, seconds=seconds, jitter=0.001)
    assert is_repeated(other, first) is is_same
