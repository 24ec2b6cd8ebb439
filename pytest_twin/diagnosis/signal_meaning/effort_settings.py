"""Settings of what recorded efforts are: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class EffortSettings:
    """Thresholds by which a law (measured, commanded, of a servo) explains recorded efforts.

    They were chosen on simulated recordings of each law with jitter and delays.

    Attributes:
        fewest_samples: smallest number of samples of a recording that is examined.
        ahead: ratio of the residuals of another law and of the best one from which the best is the
            answer.
        explains: largest residual of a law that explains the efforts, as a share of their standard
            deviation.
        reach: largest age of an effort that is tried, in sample periods, in both directions.
        parts: steps of the age on either side.
        late: smallest age that is reported, in sample periods.
        less: largest ratio of the residuals with and without an age that is reported.
        alike: ratio of residuals up to which two laws explain the efforts equally well.
        kept: share of the samples in a residual; the largest values, next to jumps, are left out.
        equal: largest error of gain and offset with which an effort equals its command. It is
            smaller than the accuracy of drives.
        smooth: samples over which positions and velocities are smoothed.
        fine: points of the fine grid in each sample period.
        most_recordings: number of recordings that are examined, those with the largest variance of
            the efforts.
        explained_motion: largest RMS residual of a fit, in encoder noises, whose drive is used to
            explain the efforts.
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
    most_recordings: int = 3
    explained_motion: float = 4.0


EFFORTS = EffortSettings()
