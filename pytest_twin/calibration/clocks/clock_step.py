"""Find a step of one of two clocks: it was set, or a stream lost samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.clocks.offset import ClockFit
from pytest_twin.calibration.clocks.residuals import residuals_of
from pytest_twin.calibration.clocks.streams import PoseStream

_LEAST_STEP_S = 0.005
"""Smallest step. A smaller one moves the frames by less than the errors of such streams."""
_FEWEST = 5
"""Fewest seconds before and after a step."""
_CHANCE = 1e-4
"""Significance level of a step beside a drift (Bonferroni over the seconds)."""


def clock_step(
    hand: PoseStream, camera: PoseStream, seen: FloatArray, fit: ClockFit, middle: float
) -> str:
    """Return the step of the offset with its time as text; empty if a drift explains as much.

    Args:
        seen: (n, 4, 4) poses of the camera stream as ``robot_world`` carries them.
        fit: fit without a drift.
        middle: time of the camera's clock at which the offset holds, s.
    """
    without_drift = residuals_of(hand, camera, seen, replace(fit, drift=0.0), middle)
    count = len(without_drift.error)
    if count < 2 * _FEWEST:
        return ""
    rate, error = np.nan_to_num(without_drift.rate), without_drift.error
    order = np.linspace(-1.0, 1.0, count)[:, None]
    drifting = [rate, rate * order]
    with_drift, _ = _left(drifting, error)
    best: tuple[float, int, float] = (np.inf, 0, 0.0)
    for cut in range(_FEWEST, count - _FEWEST + 1):
        after = (np.arange(count) >= cut)[:, None] * rate
        left, (_, _, step) = _left([*drifting, after], error)
        if left < best[0]:
            best = (left, cut, float(step))
    left, cut, step = best
    free = error.size - 3
    ratio = (with_drift - left) / max(left / free, 1e-300)
    chance = count * float(stats.f.sf(ratio, 1, free))
    if chance > _CHANCE or abs(step) < _LEAST_STEP_S:
        return ""
    at = float(camera.time[0]) + (cut / count) * float(np.ptp(camera.time))
    return (
        f"near {at:.0f} s of the camera's stream the offset changes by about "
        f"{1e3 * abs(step):.0f} ms at once: one of the clocks was set, or a stream lost "
        "samples; calibrate the parts before and after apart"
    )


def _left(columns: list[FloatArray], error: FloatArray) -> tuple[float, FloatArray]:
    """Return the squared rest of (n, 3) errors after a least-squares fit, and its coefficients."""
    table = np.stack([column.ravel() for column in columns], axis=1)
    coefficients = np.asarray(np.linalg.lstsq(table, error.ravel(), rcond=None)[0], dtype=float)
    return float(np.sum((error.ravel() - table @ coefficients) ** 2)), coefficients
