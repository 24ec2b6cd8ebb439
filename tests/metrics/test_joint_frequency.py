"""Frequency responses of a recorded joint compared with a known filter."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from pytest_twin.metrics.joint_frequency import effort_response, joint_responses
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.report.frequency import figures_of, rows_of
from pytest_twin.trial import Trial, make_trials, recordings_at
from pytest_twin.twin import DEFAULT_TOPICS

RATE = 200.0
HERTZ, DAMPING = 8.0, 0.2


def recorded(path: Path, effort: float) -> Trial:
    """A trial of a second-order joint response and an effort of ``effort`` times the command."""
    w = 2 * np.pi * HERTZ
    sections = signal.tf2sos(*signal.bilinear([w**2], [1, 2 * DAMPING * w, w**2], RATE))
    random = np.random.default_rng(0)
    command = random.standard_normal(8000)
    motion = signal.sosfilt(sections, command)
    rows = np.column_stack([
        np.arange(8000) / RATE, motion, effort * command, command,
    ])  # fmt: skip
    options = RecordingOptions(command_mode="position")
    header = "time,knee.position,knee.effort,knee.command"
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=header, comments="")
    return make_trials(recordings_at(path, DEFAULT_TOPICS)[0], None, options)[0]


@pytest.mark.usefixtures("rendered_figures")
def test_resonances_of_recording_and_model_are_reported(tmp_path: Path) -> None:
    trial = recorded(tmp_path / "noise.csv", 2.0)
    stiffer = np.gradient(trial.position[:, 0])
    command, effort = joint_responses(trial, "knee", stiffer)
    said = command.to_json()
    peak = HERTZ * np.sqrt(1.0 - 2.0 * DAMPING**2)
    assert said["measured"]["resonance"]["frequency"] == pytest.approx(peak, rel=0.05)
    assert (said["input"], said["unit"], said["recording"]) == ("command", "1", "noise.csv")
    assert said["predicted"]["magnitude_db"] != said["measured"]["magnitude_db"]
    # The effort is twice the command: the response to it is 6 dB lower.
    shared = np.isin(command.measured.frequency, effort.measured.frequency)
    ratio = command.measured.magnitude[shared] / effort.measured.magnitude
    np.testing.assert_allclose(ratio, 2.0, rtol=0.01)
    row, _ = rows_of([said, effort.to_json()])
    assert "Hz, +" in row["resonance"]
    assert "model:" in row["resonance"]
    ((_, address),) = figures_of([said])
    drawing = base64.b64decode(address.split(",")[1]).decode()
    # Axis labels are plain numbers instead of formulas.
    assert "mathdefault" not in drawing
    assert ">10</text>" in drawing


def test_an_effort_without_signal_has_no_frequency_response(tmp_path: Path) -> None:
    trial = recorded(tmp_path / "noise.csv", 0.0)
    assert [one.input for one in joint_responses(trial, "knee")] == ["command"]


def test_the_response_to_an_effort_needs_no_command() -> None:
    time = np.arange(8000) / RATE
    effort = np.random.default_rng(0).standard_normal(8000)
    motion = 0.5 * signal.lfilter([0.2], [1.0, -0.8], effort)
    found = effort_response("knee", "noise.csv", time, effort, motion)
    assert found is not None
    assert found.input == "effort"
    _, exact = signal.freqz([0.1], [1.0, -0.8], found.measured.frequency, fs=RATE)
    np.testing.assert_allclose(found.measured.magnitude, np.abs(exact), rtol=0.1)
    assert effort_response("knee", "short.csv", time[:50], effort[:50], motion[:50]) is None
    unrelated = np.random.default_rng(1).standard_normal(8000)
    assert effort_response("knee", "noise.csv", time, unrelated, motion) is None
