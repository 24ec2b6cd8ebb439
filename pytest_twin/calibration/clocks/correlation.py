"""Estimate the time offset of two pose streams by cross-correlation of their angular speeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.clocks.streams import PoseStream
from pytest_twin.metrics.lag import best_lag

LEAST_CORRELATION = 0.5
"""Smallest correlation of the angular speeds of streams of the same motion. Streams of one motion
with a few millimetres of noise have more than 0.8, streams of two motions less than 0.4."""

MOST_RIVAL = 0.95
"""Fraction of the largest correlation above which a second peak may be the right offset. It occurs
if the motion is periodic."""

_WINDOW_S = 0.1
"""Time over which the angular speed is measured. Shorter windows measure the noise of the
orientation."""
_STEP_S = 0.01
"""Time step of the grid on which the angular speeds are correlated."""
_MOST_SAMPLES = 2_000_000
"""Largest number of samples of this grid. Longer streams get a larger step."""


@dataclass(frozen=True)
class SpeedCorrelation:
    """Result of the cross-correlation of angular speeds.

    Attributes:
        offset: time of the hand's clock minus the same time of the camera's clock, s.
        correlation: correlation of the angular speeds at this offset, -1 to 1.
        rival: largest correlation at another peak, divided by ``correlation``.
    """

    offset: float
    correlation: float
    rival: float


def correlate_speeds(hand: PoseStream, camera: PoseStream) -> SpeedCorrelation:
    """Return the offset with the largest correlation of the angular speeds.

    The angular speed of a rigid body is the same at each point and in each frame, so no hand-eye
    transform is needed.
    """
    span = max(stream.time[-1] - stream.time[0] for stream in (hand, camera))
    step = max(_STEP_S, 2.0 * span / _MOST_SAMPLES)
    mine, theirs = _speed(hand, step), _speed(camera, step)
    found = best_lag(mine, theirs, 2.0 * _WINDOW_S / step)
    offset = found.steps * step + hand.time[0] - camera.time[0]
    return SpeedCorrelation(float(offset), found.correlation, found.rival)


def _speed(stream: PoseStream, step: float) -> FloatArray:
    """Angular speed on a regular grid, rad/s."""
    return angular_speed(stream, np.arange(stream.time[0], stream.time[-1], step))


def angular_speed(stream: PoseStream, time: FloatArray) -> FloatArray:
    """(n,) mean angular speed over 0.1 s around the given times, rad/s."""
    before = Rotation.from_matrix(stream.at(time - _WINDOW_S / 2)[:, :3, :3])
    after = Rotation.from_matrix(stream.at(time + _WINDOW_S / 2)[:, :3, :3])
    return np.asarray((before.inv() * after).magnitude() / _WINDOW_S, dtype=np.float64)
