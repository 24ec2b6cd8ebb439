"""Compare efforts and frequency responses of a replay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.metrics.recorded_frequency import (
    compare_responses,
    recorded_response,
    resample_uniformly,
    response_difference,
)
from pytest_twin.metrics.residual import residual

if TYPE_CHECKING:
    from pytest_twin.open_loop import Replayed

RESPONSES: Mapping[str, tuple[str, str]] = {
    "magnitude": ("frequency", "magnitude"),
    "phase": ("frequency", "phase"),
    "bandwidth": ("frequency", "bandwidth"),
    "resonance": ("frequency", "resonance"),
    "effort_magnitude": ("effort_frequency", "magnitude"),
    "effort_phase": ("effort_frequency", "phase"),
}
"""Tolerance -> response that it bounds (from the command, or from the effort), and its number."""
_UNSUPPORTED = {
    "frequency": "no frequency of {joint!r} is supported: the recording is too short, its commands "
    "are no positions, or the coherence with the command is too low",
    "effort_frequency": "no frequency from effort to position of {joint!r} is supported: the "
    "recording is too short, it has no effort of both signs, or the coherence is too low",
}
MISSING = {
    "effort_rms": "the recording has no effort of {joint!r}",
    **{name: _UNSUPPORTED[source] for name, (source, _) in RESPONSES.items()},
    "bandwidth": "recording and model do not both show a bandwidth of {joint!r}: the response "
    "falls by 3 dB below its lowest frequency outside the frequencies that are supported",
    "resonance": "recording and model do not both show a resonance of {joint!r} within the "
    "frequencies that are supported",
}
"""Tolerance -> reason why its number is missing, for errors."""


def effort_rms(results: Sequence[Replayed], joint: str) -> float | None:
    """Return root mean square of predicted minus measured effort, N*m or N, or None."""
    measured, predicted = [], []
    for result in results:
        trial = result.trial
        if trial.effort is None:
            continue
        column = trial.joints.index(joint)
        known = np.isfinite(trial.effort[:, column]) & np.isfinite(result.effort[:, column])
        measured.append(trial.effort[known, column])
        predicted.append(result.effort[known, column])
    if not measured or not sum(map(len, measured)):
        return None
    return residual(np.concatenate(predicted), np.concatenate(measured)).rms


def frequency(results: Sequence[Replayed], joint: str) -> dict[str, Any] | None:
    """Compare frequency responses from command to position, over the longest section.

    The result is None if excitation, sensor and coherence support no frequency: see
    :func:`pytest_twin.metrics.recorded_frequency.recorded_response`.
    """
    result = max(results, key=lambda one: one.trial.duration)
    trial = result.trial
    if trial.mode_of(joint) != "position":
        return None
    column = trial.joints.index(joint)
    command = trial.setpoint.at(trial.time)[:, trial.command_joints.index(joint)]
    found = _resample_evenly(
        trial.time, command, result.position[:, column], trial.position[:, column]
    )
    if found is None:
        return None
    rate, (sent, ours, theirs) = found
    apart = compare_responses(sent, ours, theirs, rate)
    return None if apart is None else asdict(apart)


def effort_frequency(results: Sequence[Replayed], joint: str) -> dict[str, Any] | None:
    """Compare frequency responses from effort to position, over the longest section.

    The model's response is that to the model's own effort, so that it shows the mechanics without
    the controller. The result is None if excitation, sensor and coherence support no frequency.
    """
    result = max(results, key=lambda one: one.trial.duration)
    trial = result.trial
    column = trial.joints.index(joint)
    if trial.effort is None or not np.any(trial.effort[:, column] < 0.0):
        return None
    found = _resample_evenly(
        trial.time, result.effort[:, column], result.position[:, column],
        trial.effort[:, column], trial.position[:, column],
    )  # fmt: skip
    if found is None:
        return None
    rate, (our_effort, ours, their_effort, theirs) = found
    apart = response_difference(
        recorded_response(our_effort, ours, rate), recorded_response(their_effort, theirs, rate)
    )
    return None if apart is None else asdict(apart)


def _resample_evenly(
    time: FloatArray, *series: FloatArray
) -> tuple[float, tuple[FloatArray, ...]] | None:
    """Return rate and series at equal intervals, where all are known; None if there are too few."""
    known = np.all(np.isfinite(series), axis=0)
    if known.sum() < 2 or np.any(np.diff(time[known]) < 0):
        return None
    return resample_uniformly(time[known], *(one[known] for one in series))
