"""Timing of a camera: delay, period, jitter and lost frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pytest_twin.arrays import FloatArray


@dataclass(frozen=True)
class CameraTiming:
    """Camera timing: a frame with the stamp ``t`` shows the scene at ``t - delay``.

    Attributes:
        delay: total delay by exposure, transfer and clock offset, s.
        period: time between two frames, s.
        jitter: standard deviation of a stamp from the regular grid of frames, s.
        lost: fraction of missing frames.
    """

    delay: float
    period: float
    jitter: float
    lost: float

    def seen(self, stamps: FloatArray, turns: Slerp) -> Rotation:
        """Return the orientations that the frames show.

        Args:
            stamps: (n,) stamps of frames, s.
            turns: true orientations over time, s. Frames outside of its time range show the
                orientation at its start or end.
        """
        return turns(np.clip(stamps - self.delay, turns.times[0], turns.times[-1]))


def frames_of(stamps: FloatArray) -> tuple[float, float, float]:
    """Period (s), jitter (s) and fraction of lost frames of (n,) ascending stamps, s.

    The difference of two stamps has twice the variance of independent jitter.
    """
    apart = np.diff(stamps)
    period = float(np.median(apart))
    steps = np.maximum(np.round(apart / period), 1.0)
    period = float(np.sum(apart) / np.sum(steps))
    jitter = float(np.std(apart - steps * period) / np.sqrt(2.0))
    return period, jitter, float(1.0 - len(apart) / np.sum(steps))
