"""Detect mistakes in recorded commands from how the positions follow them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.effort.input_mistakes import InputMistake
from pytest_twin.metrics.recorded_frequency import resample_uniformly
from pytest_twin.trial import Trial

_FOLLOWS = 0.7
"""Smallest correlation of positions and commands, of either sign, for a conclusion."""
_FAR = 8.0
"""Ratio of the changes of position and command that no servo explains. Friction leaves 0.2 of small
commands of an SO-101 arm."""
_LATEST, _LAGS = 0.2, 20
"""Largest time, s, by which a position may follow its command late, and number of times tried."""
_MOVED = 1e-3
"""Root mean square of commands and positions, rad or m, below which a joint does not move."""


def command_mistakes(trials: Sequence[Trial]) -> list[InputMistake]:
    """Return suspected mistakes in position commands: sign, unit, or side of the gear."""
    found = []
    for joint in dict.fromkeys(name for trial in trials for name in trial.joints):
        pairs = [pair for trial in trials if (pair := _pair(trial, joint)) is not None]
        if not pairs:
            continue
        changes = [
            float(np.sqrt(np.mean(np.concatenate(each) ** 2)))
            for each in zip(*(pair[1:] for pair in pairs), strict=True)
        ]
        if min(changes) < _MOVED:
            continue
        ratio = changes[1] / changes[0]
        correlation = _correlation(pairs)
        if correlation < -_FOLLOWS:
            found.append(InputMistake(
                joint,
                f"{joint}: the position moves against its command (correlation "
                f"{correlation:.2f}): the sign of one of them is wrong",
                f"calibration: joints: {joint}: {{sign: -1}} where the encoder counts the other "
                "way, else the sign of the recorded command",
            ))  # fmt: skip
        elif correlation > _FOLLOWS and abs(math.log(ratio)) > math.log(_FAR):
            found.append(InputMistake(
                joint,
                f"{joint}: the position changes by {ratio:.3g} where the command changes by 1: "
                "another unit, or the other side of a gear",
                f"record {joint}'s position and command in one unit, on the joint's side of the "
                "gear",
            ))  # fmt: skip
    return found


def _pair(trial: Trial, joint: str) -> tuple[float, FloatArray, FloatArray] | None:
    """Return rate (Hz), command and position of a joint about their means, at equal intervals."""
    if joint not in trial.command_joints or trial.mode_of(joint) != "position":
        return None
    command = trial.setpoint.at(trial.time)[:, trial.command_joints.index(joint)]
    position = trial.position[:, trial.joints.index(joint)]
    known = np.isfinite(command) & np.isfinite(position)
    if known.sum() < 2:
        return None
    rate, (asked, moved) = resample_uniformly(trial.time[known], command[known], position[known])
    return rate, asked - asked.mean(), moved - moved.mean()


def _correlation(pairs: Sequence[tuple[float, FloatArray, FloatArray]]) -> float:
    """Return the correlation of largest size over the times by which positions may be late."""
    found = []
    for lag in np.linspace(0.0, _LATEST, _LAGS):
        asked, moved = [], []
        for rate, command, position in pairs:
            late = min(round(lag * rate), len(command) - 1)
            asked.append(command[: len(command) - late])
            moved.append(position[late:])
        c, q = np.concatenate(asked), np.concatenate(moved)
        size = float(np.linalg.norm(c) * np.linalg.norm(q))
        found.append(float(c @ q) / max(size, 1e-300))
    return max(found, key=abs)
