"""Frequency responses of an identification whose recordings have efforts and no commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import signal

from pytest_twin.identification.closed_loop import effort_responses
from pytest_twin.identification.measured_recordings import MeasuredRecording

RATE = 100.0


def shaken(name: str, seconds: float) -> MeasuredRecording:
    """Two joints; the first follows its effort by a known filter, the second has no sensor."""
    time = np.arange(round(seconds * RATE)) / RATE
    effort = np.random.default_rng(2).standard_normal((len(time), 2))
    position = signal.lfilter([0.1], [1.0, -0.9], effort, axis=0)
    effort[:, 1] = np.nan
    return MeasuredRecording(
        Path(name), 0.0, ("a", "b"), time, position, None, effort, np.zeros(2, dtype=bool),
        np.full(2, np.inf), {},
    )  # fmt: skip


def test_each_joint_has_the_recording_that_supports_the_most_frequencies() -> None:
    (one,) = effort_responses([shaken("short.csv", 5.0), shaken("long.csv", 60.0)])
    assert (one["joint"], one["input"], one["recording"]) == ("a", "effort", "long.csv")
    assert min(one["measured"]["coherence"]) >= 0.8
    assert len(one["measured"]["frequency"]) > 100


def test_recordings_that_support_no_frequency_have_no_response() -> None:
    assert effort_responses([shaken("short.csv", 0.8)]) == []
