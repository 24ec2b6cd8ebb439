"""Trials with one state, which are predicted at the stamps of the commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.trial.trial import Trial


def at_command_stamps(trial: Trial) -> Trial:
    """The trial with one row for its state and one NaN row for each later command."""
    later = np.unique(trial.command_time[trial.command_time > 0.0])
    count = 1 + len(later)

    def rows(table: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        if table is None:
            return None
        empty = np.full((count, table.shape[1]), np.nan)
        empty[0] = table[0]
        return empty

    position = rows(trial.position)
    assert position is not None
    return replace(
        trial,
        time=np.append(0.0, later),
        position=position,
        velocity=rows(trial.velocity),
        effort=rows(trial.effort),
    )


def predicted_rows(trial: Trial) -> NDArray[np.bool_]:
    """(n,) rows for which a prediction is written.

    These are all states, or the commands of a trial from :func:`at_command_stamps`.
    """
    keep = np.ones(len(trial.time), dtype=bool)
    if len(trial.time) > 1 and not np.isfinite(trial.position[1:]).any():
        keep[0] = bool((trial.command_time == 0.0).any())
    return keep
