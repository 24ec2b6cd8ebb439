"""Measured efforts against predicted ones, where an effort jumps beside its stamp.

The effort of a servo jumps with each command. Whether it is measured just before or just after a
jump is below what a stamp tells and what a simulator resolves. A comparison of effects must not be
decided by that: an effort agrees if it lies between the predicted ones of neighbouring steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis, effect_values
from pytest_twin.diagnosis.problem import Problem


def within_a_step(
    problem: Problem,
    hypotheses: Sequence[Hypothesis],
    residuals: Sequence[FloatArray],
    segments: NDArray[np.int64],
) -> list[FloatArray]:
    """(samples, signals) residuals whose efforts count from the range of one step to either side.

    Args:
        problem: what to explain.
        hypotheses: sets of effects.
        residuals: (samples, signals) that each leaves.
        segments: of which segments.
    """
    joints = len(problem.joints)
    if problem.effort_floor is None or not hypotheses:
        return list(residuals)
    each = [h for h in hypotheses for _ in segments]
    rows = np.tile(segments, len(hypotheses))
    beside = problem.simulator.efforts_beside(rows, effect_values(each, joints, problem.scales))
    out = []
    for i, residual in enumerate(residuals):
        lows, highs = list[FloatArray](), list[FloatArray]()
        mine = beside[i * len(segments) : (i + 1) * len(segments)]
        for s, (here, earlier, later) in zip(segments, mine, strict=True):
            around = np.stack([here, earlier, later])
            lows.append(problem.trusted(int(s), around.min(axis=0) - here))
            highs.append(problem.trusted(int(s), around.max(axis=0) - here))
        off = residual[:, joints:]
        low, high = np.concatenate(lows), np.concatenate(highs)
        banded = np.maximum(off - high, 0.0) + np.minimum(off - low, 0.0)
        out.append(np.concatenate([residual[:, :joints], banded], axis=1))
    return out
