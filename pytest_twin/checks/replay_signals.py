"""Compare efforts and frequency responses of a replay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.metrics.recorded_frequency import compared, uniform
from pytest_twin.metrics.residual import residual

if TYPE_CHECKING:
    from pytest_twin.replay import Replayed

MISSING = {
    "effort_rms": "the recording has no effort of {joint!r}",
    "magnitude": "no frequency of {joint!r} is supported: the recording is too short, its commands "
    "are no positions, or the coherence with the command is too low",
}
MISSING["phase"] = MISSING["magnitude"]
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
    measured, predicted = trial.position[:, column], result.position[:, column]
    known = np.isfinite(measured) & np.isfinite(predicted) & np.isfinite(command)
    time = trial.time[known]
    if len(time) < 2 or np.any(np.diff(time) < 0):
        return None
    rate, (sent, ours, theirs) = uniform(time, command[known], predicted[known], measured[known])
    found = compared(sent, ours, theirs, rate)
    return None if found is None else asdict(found)
