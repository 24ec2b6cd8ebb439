"""Windows so short that the nominal model stays near what was recorded.

What a law would add is carried to positions by the equation of deviations, which holds while these
are small. An arm that nothing holds may part from its model within half a second by as much as it
moves (a load that the model does not carry): there no slope leads to the law that is missing.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem

# Of what a joint moves in a window, root mean squares over windows, by which it may be off.
_NEAR = 0.25
SHORTEST = 0.1
"""s, of windows that are worth it: a start is taken from samples around it."""


def typical_window_length(problem: Problem) -> float:
    """s, that segments last, most of them."""
    return float(np.median([s.time[-1] - s.time[0] for s in problem.simulator.segments]))


def model_follows_recordings(problem: Problem, left: FloatArray) -> bool:
    """Whether every joint stays near its recordings, by how far it moves in a segment.

    Args:
        problem: of segments.
        left: (samples, signals) residuals of all segments.
    """
    segments = problem.simulator.segments
    joints = len(problem.joints)
    travel = np.array([np.ptp(s.position, axis=0) for s in segments])
    off = np.mean(left[:, :joints] ** 2, axis=0)
    return bool((off <= _NEAR**2 * np.mean(travel**2, axis=0)).all())
