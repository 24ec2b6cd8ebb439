"""Settings of what recorded efforts are: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class EffortSettings:
    """Thresholds by which a law (measured, commanded, of a servo) explains recorded efforts.

    They were chosen on simulated recordings of each law with jitter and delays.

    Attributes:
        fewest_samples: of a recording that is asked.
        ahead: factor on the deviation that the best law leaves, by which any other must leave more.
        explains: share of the efforts' deviation that a law may leave to say anything.
        reach: sample periods by which an effort is tried to be older, or newer, than its stamp.
        parts: steps of that offset on either side.
        late: share of a sample period from which an offset in time is real.
        less: share of the deviation without the offset below which it is real.
        alike: ratio of deviations up to which two laws explain the efforts alike.
        kept: share of the samples that a deviation is of; the largest, beside jumps, are left out.
        equal: error of gain and offset up to which an effort is the command: less than drives are
            calibrated to.
        smooth: samples over which positions and velocities are smoothed.
        fine: points of the fine grid in a sample period.
    """

    fewest_samples: int = 50
    ahead: float = 1.5
    explains: float = 0.25
    reach: float = 1.5
    parts: int = 15
    late: float = 0.15
    less: float = 0.8
    alike: float = 1.2
    kept: float = 0.9
    equal: float = 0.005
    smooth: int = 7
    fine: int = 20


EFFORTS = EffortSettings()
