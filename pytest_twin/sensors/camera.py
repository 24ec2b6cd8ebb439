"""When a camera saw what its stamps say: delay, period, jitter and lost frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pytest_twin.arrays import FloatArray


@dataclass(frozen=True)
class CameraTiming:
    """A frame with the stamp ``t`` shows what was there at ``t - delay``.

    Attributes:
        delay: s; exposure, transfer and a clock that is ahead all are in it.
        period: s between two frames.
        jitter: standard deviation of a stamp from the regular grid of frames, s.
        lost: share of the frames that are missing.
    """

    delay: float
    period: float
    jitter: float
    lost: float

    def seen(self, stamps: FloatArray, turns: Slerp) -> Rotation:
        """The orientations that frames show.

        Args:
            stamps: (n,) of frames, s.
            turns: true orientations over time, s. Frames before its start or after its end show
                its ends.
        """
        return turns(np.clip(stamps - self.delay, turns.times[0], turns.times[-1]))


def frames_of(stamps: FloatArray) -> tuple[float, float, float]:
    """Period (s), jitter (s) and share of lost frames of (n,) ascending stamps, s.

    Jitter that is independent from frame to frame is in the difference of two stamps twice.
    """
    apart = np.diff(stamps)
    period = float(np.median(apart))
    steps = np.maximum(np.round(apart / period), 1.0)
    period = float(np.sum(apart) / np.sum(steps))
    jitter = float(np.std(apart - steps * period) / np.sqrt(2.0))
    return period, jitter, float(1.0 - len(apart) / np.sum(steps))
