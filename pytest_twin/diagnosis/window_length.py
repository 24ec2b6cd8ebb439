"""Lengths of windows in which the nominal model stays close to the recordings.

The linearized dynamics are valid only for small deviations. Without a servo, an arm with an unknown
payload can deviate from the model within 0.5 s by as much as it moves. No gradient then leads to
the missing effect.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.window_settings import WINDOWS


def typical_window_length(problem: Problem) -> float:
    """Median duration of the segments, s."""
    return float(np.median([s.time[-1] - s.time[0] for s in problem.simulator.segments]))


def window_of_errors(problem: Problem) -> float | None:
    """Duration of the windows in which the errors of a problem are measured, s.

    None if whole recordings are predicted, each from its first state.
    """
    segments = [problem.simulator.segments[s] for s in problem.tested_segments]
    if not all(s.starts_in_motion for s in segments):
        return None
    return float(np.median([s.time[-1] - s.time[0] for s in segments]))


def model_follows_recordings(problem: Problem, left: FloatArray) -> bool:
    """Whether the RMS error of every joint that moves is small against its travel in a segment.

    Args:
        left: (samples, signals) residuals of all segments.
    """
    segments = problem.simulator.segments
    joints = len(problem.joints)
    travel = np.array([np.ptp(s.position, axis=0) for s in segments])
    mean_square = np.mean(left[:, :joints] ** 2, axis=0)
    square_travel = np.mean(travel**2, axis=0)
    rests = square_travel <= (WINDOWS.at_rest * problem.floor) ** 2
    return bool((rests | (mean_square <= WINDOWS.near**2 * square_travel)).all())
