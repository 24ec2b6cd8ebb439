"""Time offset of two pose streams from their angular speeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.clocks.streams import PoseStream
from pytest_twin.metrics.lag import best_lag

LEAST_CORRELATION = 0.5
"""Correlation of the angular speeds below which the streams do not show the same motion. Streams of
one motion with a few millimetres of noise have above 0.8, of two motions below 0.4."""

MOST_RIVAL = 0.95
"""A second offset whose correlation is above this part of the best one may be the right one: the
motion repeats itself."""

_WINDOW_S = 0.1
"""Over which a turn is measured: shorter windows measure the noise of the orientation."""
_STEP_S = 0.01
_MOST_SAMPLES = 2_000_000


@dataclass(frozen=True)
class Correlated:
    """What the angular speeds say.

    Attributes:
        offset: s; a stamp of the camera's clock plus this is a time of the hand's clock.
        correlation: of the angular speeds there, -1 to 1.
        rival: the largest correlation at another peak, divided by ``correlation``.
    """

    offset: float
    correlation: float
    rival: float


def correlate_speeds(hand: PoseStream, camera: PoseStream) -> Correlated:
    """The offset at which the angular speeds of both streams are most alike.

    The speed of a rigid body's rotation is the same wherever it is measured, so that it needs no
    hand-eye transform.
    """
    span = max(stream.time[-1] - stream.time[0] for stream in (hand, camera))
    step = max(_STEP_S, 2.0 * span / _MOST_SAMPLES)
    mine, theirs = _speed(hand, step), _speed(camera, step)
    found = best_lag(mine, theirs, 2.0 * _WINDOW_S / step)
    offset = found.steps * step + hand.time[0] - camera.time[0]
    return Correlated(float(offset), found.correlation, found.rival)


def _speed(stream: PoseStream, step: float) -> FloatArray:
    """Angular speed on a regular grid, rad/s."""
    return angular_speed(stream, np.arange(stream.time[0], stream.time[-1], step))


def angular_speed(stream: PoseStream, time: FloatArray) -> FloatArray:
    """(n,) angular speed over 0.1 s around some times, rad/s."""
    before = Rotation.from_matrix(stream.at(time - _WINDOW_S / 2)[:, :3, :3])
    after = Rotation.from_matrix(stream.at(time + _WINDOW_S / 2)[:, :3, :3])
    return np.asarray((before.inv() * after).magnitude() / _WINDOW_S, dtype=np.float64)
