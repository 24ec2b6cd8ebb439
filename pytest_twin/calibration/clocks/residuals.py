"""Errors of two streams, with the speed and reach that they may depend on."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.clocks.offset import SLOPE_S, ClockFit, hand_times
from pytest_twin.calibration.clocks.streams import PoseStream
from pytest_twin.calibration.residual_patterns import Residuals

_APART_S = 1.0
"""Time between the poses used. Errors of poses closer in time are correlated."""


def residuals_of(
    hand: PoseStream, camera: PoseStream, seen: FloatArray, fit: ClockFit, middle: float
) -> Residuals:
    """Errors of the target's position, one per second, in the frame that the target is fixed to.

    Args:
        seen: (n, 4, 4) poses of the camera stream as ``robot_world`` carries them.
        middle: time of the camera's clock at which the offset holds, s.
    """
    time = hand_times(camera, fit.offset, fit.drift, middle)
    inside = np.flatnonzero((time - SLOPE_S >= hand.time[0]) & (time + SLOPE_S <= hand.time[-1]))
    _, first = np.unique(np.floor(time[inside] / _APART_S), return_index=True)
    chosen = inside[first]
    time, back = time[chosen], fit.target_in_hand(seen[chosen])

    def place(at: FloatArray) -> FloatArray:
        return np.asarray((hand.at(at) @ back)[:, :3, 3])

    error = place(time) - fit.solved.robot_world[:3, 3]
    return Residuals(
        error,
        error,
        np.linalg.norm(hand.at(time)[:, :3, 3], axis=1),
        (place(time + SLOPE_S) - place(time - SLOPE_S)) / (2.0 * SLOPE_S),
        [""] * len(time),
    )
