"""Measured efforts against predicted ones, where an effort jumps beside its stamp.

The effort of a servo jumps with each command. Whether it is measured just before or just after a
jump is below what a stamp tells and what a simulator resolves. A comparison of effects must not be
decided by that: an effort agrees if it lies between the predicted ones of neighbouring steps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis, effect_values
from pytest_twin.diagnosis.problem import Problem


def within_a_step(
    problem: Problem, hypothesis: Hypothesis, residual: FloatArray, segments: NDArray[np.int64]
) -> FloatArray:
    """(samples, signals) residual whose efforts count from the range of one step to either side.

    Args:
        problem: what to explain.
        hypothesis: the set of effects.
        residual: (samples, signals) that it leaves.
        segments: of which segments.
    """
    joints = len(problem.joints)
    if problem.effort_floor is None:
        return residual
    values = effect_values([hypothesis] * len(segments), joints, problem.scales)
    lows, highs = list[FloatArray](), list[FloatArray]()
    beside = problem.simulator.efforts_beside(segments, values)
    for s, (here, earlier, later) in zip(segments, beside, strict=True):
        around = np.stack([here, earlier, later])
        lows.append(problem.trusted(int(s), around.min(axis=0) - here))
        highs.append(problem.trusted(int(s), around.max(axis=0) - here))
    off = residual[:, joints:]
    low, high = np.concatenate(lows), np.concatenate(highs)
    banded = np.maximum(off - high, 0.0) + np.minimum(off - low, 0.0)
    return np.concatenate([residual[:, :joints], banded], axis=1)
