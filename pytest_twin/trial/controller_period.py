"""Setpoints of a trajectory as a controller holds them from one update to the next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import Recording
from pytest_twin.recording_options import LONGEST_PERIOD, RecordingOptions
from pytest_twin.trial.trial import Trial

_KEY = "controller_period"
# Setpoints of one trial, which bound its memory.
_MOST_UPDATES = 20_000_000
_STATE = "JointTrajectoryControllerState"


def period_of(recording: Recording, options: RecordingOptions) -> float | None:
    """Update period of the controller, s: an option, else the trial's metadata; None without one.

    Raises:
        RecordingError: the metadata state no period.
    """
    if options.controller_period is not None:
        return options.controller_period
    stated = recording.metadata.get(_KEY)
    if stated is None:
        return None
    try:
        period = float(stated)
    except ValueError:
        period = 0.0
    if not 0.0 < period <= LONGEST_PERIOD:
        raise RecordingError(
            "controller_period of the trial's metadata is no period", path=recording.path,
            where="metadata 'trial'", value=stated, unit="s",
            expected=f"a number of s, more than 0 and at most {LONGEST_PERIOD:g}",
        )  # fmt: skip
    return period


def held_by_controller(trial: Trial, period: float) -> Trial:
    """Return the trial with the setpoint that the controller takes at each update and holds.

    The updates begin with the first trajectory: that is the first update that knows it. A delay
    until then is a delay of the commands.

    Args:
        trial: a trial whose setpoint moves on between its stamps.
        period: s.

    Raises:
        RecordingError: too many updates.
    """
    first, last = float(trial.command_time[0]), float(trial.command_time[-1])
    updates = int(np.ceil((last - first) / period)) + 1
    if updates * len(trial.command_joints) > _MOST_UPDATES:
        raise RecordingError(
            "too many updates of the controller", path=trial.path, value=updates,
            expected="a longer controller_period, or a shorter recording",
        )  # fmt: skip
    time = np.asarray(first + period * np.arange(updates), dtype=np.float64)
    return replace(
        trial,
        command_time=time,
        command=trial.setpoint.at(time),
        own_commands=None,
        command_between="held",
        notes=(
            *trial.notes,
            f"the controller holds each setpoint of its trajectories for {1e3 * period:.4g} ms",
        ),
    )


def period_note(recording: Recording) -> str:
    """The question for the period of a controller that plays trajectories."""
    topic = recording.series["command"].topic
    note = (
        f"{topic}: the setpoint of trajectories is taken to move on continuously; a controller "
        "that holds it for its update period moves the joints half a period later, which looks "
        "like a delay: --controller-period SECONDS, or controller_period in twin.yaml or in the "
        "trial's metadata"
    )
    states = [one.name for one in recording.topics if _STATE in one.type]
    if states:
        note += f"; {states[0]} has the setpoints as they were used (--topics command={states[0]})"
    return note
