"""Time offset of two pose streams from their angular speeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate, correlation_lags
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.clocks.streams import PoseStream

LEAST_CORRELATION = 0.5
"""Correlation of the angular speeds below which the streams do not show the same motion. Streams of
one motion with a few millimetres of noise have above 0.8, of two motions below 0.4."""

MOST_RIVAL = 0.95
"""A second offset whose correlation is above this part of the best one may be the right one: the
motion repeats itself."""

_WINDOW_S = 0.1
"""Over which a turn is measured: shorter windows measure the noise of the orientation."""
_STEP_S = 0.01
_LEAST_OVERLAP = 0.3
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
    best = _correlations(mine, theirs)
    lags = correlation_lags(len(mine), len(theirs))
    at = int(np.argmax(best))
    fine = 0.0
    if 0 < at < len(best) - 1:
        left, top, right = best[at - 1 : at + 2]
        bend = left - 2.0 * top + right
        fine = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    offset = (lags[at] + fine) * step + hand.time[0] - camera.time[0]
    peaks = np.flatnonzero((best[1:-1] >= best[:-2]) & (best[1:-1] >= best[2:])) + 1
    others = peaks[np.abs(peaks - at) * step > 2.0 * _WINDOW_S]
    top = float(best[at])
    rival = float(best[others].max() / top) if len(others) and top > 0.0 else 0.0
    return Correlated(float(offset), top, rival)


def _speed(stream: PoseStream, step: float) -> FloatArray:
    """Angular speed on a regular grid, rad/s."""
    time = np.arange(stream.time[0], stream.time[-1], step)
    before = Rotation.from_matrix(stream.at(time - _WINDOW_S / 2)[:, :3, :3])
    after = Rotation.from_matrix(stream.at(time + _WINDOW_S / 2)[:, :3, :3])
    return np.asarray((before.inv() * after).magnitude() / _WINDOW_S, dtype=np.float64)


def _correlations(mine: FloatArray, theirs: FloatArray) -> FloatArray:
    """Pearson's correlation at each lag, over the overlap; -1 where that is too short."""
    one, other = np.ones_like(mine), np.ones_like(theirs)
    count = np.round(correlate(one, other, method="fft"))
    count = np.maximum(count, 1.0)

    def sums(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(correlate(a, b, method="fft"), dtype=np.float64)

    mine, theirs = mine - mine.mean(), theirs - theirs.mean()
    first, second = sums(mine, other) / count, sums(one, theirs) / count
    both = sums(mine, theirs) / count - first * second
    spread = (sums(mine**2, other) / count - first**2) * (sums(one, theirs**2) / count - second**2)
    floor = 1e-6 * mine.var() * theirs.var()
    enough = count > _LEAST_OVERLAP * min(len(mine), len(theirs))
    usable = enough & (spread > max(floor, 1e-18))
    return np.where(usable, both / np.sqrt(np.maximum(spread, 1e-30)), -1.0)
