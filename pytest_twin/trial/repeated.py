"""Whether two recordings have the same commands, so that they can be compared sample by sample."""

from __future__ import annotations

import numpy as np

from pytest_twin.trial.trial import Trial

_SAME_COMMANDS = 0.05
"""RMS difference of two commands, relative to their standard deviation, up to which a motion is
repeated: jitter of the stamps of a command at 200 Hz makes 0.02, another motion 1 or more."""
_SAME_DURATION = 0.8
"""Least ratio of the durations of two repetitions."""
_SAMPLES = 2000
"""Times at which commands are compared."""


def is_repeated(trial: Trial, other: Trial) -> bool:
    """Whether a recording repeats the motion of another one: same commands, from their start."""
    last = min(float(trial.time[-1]), float(other.time[-1]))
    longest = max(float(trial.time[-1]), float(other.time[-1]))
    if set(trial.command_joints) != set(other.command_joints) or last < _SAME_DURATION * longest:
        return False
    at = np.linspace(0.0, last, _SAMPLES)
    own = trial.commands_before(at)
    columns = [other.command_joints.index(joint) for joint in trial.command_joints]
    difference = own - other.commands_before(at)[:, columns]
    spread = np.nanstd(own)
    return bool(np.sqrt(np.nanmean(difference**2)) <= _SAME_COMMANDS * spread)
