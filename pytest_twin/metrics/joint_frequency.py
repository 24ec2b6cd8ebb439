"""Frequency responses of a recorded joint, from its command or effort to its position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.metrics.frequency import Response, bandwidth, decibel, resonance
from pytest_twin.metrics.recorded_frequency import recorded_response, resample_uniformly
from pytest_twin.trial import Trial

_MIN_LINES = 3
"""Smallest number of lines of a response; with fewer, it shows neither bandwidth nor peak."""


@dataclass(frozen=True, slots=True)
class JointFrequency:
    """The response of one joint in one recording.

    Attributes:
        input: ``command`` or ``effort``; the response is the position.
        unit: unit of the magnitude.
        measured: measured response, on the lines with sufficient excitation and coherence.
        predicted: response of a model's prediction, or None.
    """

    joint: str
    input: str
    unit: str
    recording: str
    measured: Response
    predicted: Response | None

    def to_json(self) -> dict[str, Any]:
        """Return JSON-able values in Hz, dB and rad, as in a result file."""
        found = {
            "joint": self.joint,
            "input": self.input,
            "response": "position",
            "unit": self.unit,
            "recording": self.recording,
            "measured": _json(self.measured),
        }
        if self.predicted is not None:
            found["predicted"] = _json(self.predicted)
        return found


def joint_responses(
    trial: Trial, joint: str, predicted: FloatArray | None = None
) -> list[JointFrequency]:
    """Frequency responses of a joint that a recording determines; empty if it determines none.

    Args:
        trial: recording with measured positions.
        joint: name of a recorded joint.
        predicted: (n,) positions of a model at the trial's stamps, rad or m.
    """
    column = trial.joints.index(joint)
    found = []
    if joint in trial.command_joints:
        mode = trial.mode_of(joint)
        command = trial.setpoint.at(trial.time)[:, trial.command_joints.index(joint)]
        unit = "1" if mode == "position" else f"position per {mode}"
        found.append(("command", unit, command))
    if trial.effort is not None and np.any(trial.effort[:, column] < 0.0):
        found.append(("effort", "position per effort", trial.effort[:, column]))
    out = []
    for name, unit, given in found:
        series = [given, trial.position[:, column]]
        ours = predicted if name == "command" else None
        if ours is not None:
            series.append(ours)
        responses = _responses(trial.time, series)
        if responses and responses[0] is not None and len(responses[0].frequency) >= _MIN_LINES:
            theirs = responses[1] if len(responses) > 1 else None
            out.append(JointFrequency(joint, name, unit, trial.path.name, responses[0], theirs))
    return out


def effort_response(
    joint: str, recording: str, time: FloatArray, effort: FloatArray, position: FloatArray
) -> JointFrequency | None:
    """Frequency response from a signed effort to the position, where no command is recorded.

    None if the recording determines fewer than three lines.

    Args:
        time: (n,) s.
        effort, position: (n,) signals, N*m and rad, or N and m; NaN where unknown.
    """
    found = _responses(time, [effort, position])
    if not found or found[0] is None or len(found[0].frequency) < _MIN_LINES:
        return None
    return JointFrequency(joint, "effort", "position per effort", recording, found[0], None)


def _responses(time: FloatArray, series: list[FloatArray]) -> list[Response | None]:
    """Frequency response of each further series to the first."""
    known = np.all(np.isfinite(series), axis=0)
    if known.sum() < 2 or np.any(np.diff(time[known]) < 0):
        return []
    rate, (given, *answers) = resample_uniformly(time[known], *(one[known] for one in series))
    return [recorded_response(given, answer, rate) for answer in answers]


def _json(response: Response) -> dict[str, Any]:
    peak = resonance(response)
    return {
        "frequency": response.frequency.tolist(),
        "magnitude_db": decibel(response.magnitude).tolist(),
        "phase": response.phase.tolist(),
        "coherence": response.coherence.tolist(),
        "bandwidth": bandwidth(response),
        "resonance": None if peak is None else {"frequency": peak[0], "level_db": peak[1]},
    }
