"""Comparison of measured and predicted efforts with a tolerance of one time step.

The effort of a servo jumps with each command. Neither stamps nor the time step resolve whether it
was measured just before or just after a jump. The comparison of effects must not depend on this. An
effort therefore agrees if it is between the predicted efforts of neighbouring steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import Hypothesis, effect_values


def residuals_with_step_tolerance(
    problem: Problem,
    hypotheses: Sequence[Hypothesis],
    residuals: Sequence[FloatArray],
    segments: NDArray[np.int64],
) -> list[FloatArray]:
    """Residuals with efforts measured from the range of predictions within one step.

    Args:
        residuals: (samples, signals) residual of each on ``segments``.

    Returns:
        (samples, signals) residual of each; that of an effort is zero inside the range.
    """
    joints = len(problem.joints)
    if problem.effort_floor is None or not hypotheses:
        return list(residuals)
    each = [h for h in hypotheses for _ in segments]
    rows = np.tile(segments, len(hypotheses))
    efforts = problem.simulator.efforts_at_neighbouring_steps(
        rows, effect_values(each, joints, problem.scales)
    )
    out = []
    for i, residual in enumerate(residuals):
        lows, highs = list[FloatArray](), list[FloatArray]()
        of_set = efforts[i * len(segments) : (i + 1) * len(segments)]
        for s, (at_stamp, earlier, later) in zip(segments, of_set, strict=True):
            around = np.stack([at_stamp, earlier, later])
            lows.append(problem.weigh_efforts(int(s), around.min(axis=0) - at_stamp))
            highs.append(problem.weigh_efforts(int(s), around.max(axis=0) - at_stamp))
        error = residual[:, joints:]
        low, high = np.concatenate(lows), np.concatenate(highs)
        banded = np.maximum(error - high, 0.0) + np.minimum(error - low, 0.0)
        out.append(np.concatenate([residual[:, :joints], banded], axis=1))
    return out
