"""Settings of free laws: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FreeLawSettings:
    """Thresholds by which a table over one variable is fitted, described and reported.

    They were chosen on simulated pendulums and blind cases with forces outside the catalogue.

    Attributes:
        removes: share of the squared error of left-out recordings that a law must remove, in the
            linearized motion and by simulation. In the tests and blind cases, functions of the
            state reach 0.97 to 0.999, a push at the same time in all recordings 0.2, random torques
            and a shaker 0.1.
        fewest_recordings: smallest number of recordings for cross-validation.
        most_joints: largest number of joints at which laws are fitted.
        most_confidence: largest confidence in a variable, because the force may depend on one that
            is not recorded.
        most_if_early: largest confidence if the search over the effects of the catalogue ended
            early.
        least_listed: confidence of the least likely alternative that is listed.
        still: share of a joint's RMS speed below which its direction does not change.
        tail: share of samples above the last knot, for the time since a reversal, which has a long
            tail.
        beyond: linear extrapolation of a table at each end, as a share of the range of the data.
            With it, the force of a cable was predicted to 0.1 % in recordings that went 0.09 rad
            further.
        fewest_temperatures: smallest number of temperatures for a table over temperature. Two only
            determine a line, which is an effect of the catalogue.
        least_step: smallest relative reduction of the objective for which another step is made.
        acts: a table is restricted to the range with this share of its squared force, ...
        narrow: ... if that is less than this share of the whole range.
        margin: margin at each end, as a share of the new range.
        most_best: number of best tables that are tried over a narrow range, and combined in pairs.
        second: share of the remaining squared error that a second table must remove.
        second_of_all: share of the whole squared error that a second table must remove.
        described: smallest height of a described part of a curve, as a share of the peak.
        most_stretches: largest number of described parts.
    """

    removes: float = 0.5
    fewest_recordings: int = 2
    most_joints: int = 2
    most_confidence: float = 0.95
    most_if_early: float = 0.5
    least_listed: float = 1e-3
    still: float = 0.02
    tail: float = 0.01
    beyond: float = 0.1
    fewest_temperatures: int = 3
    least_step: float = 0.02
    acts: float = 0.98
    narrow: float = 0.5
    margin: float = 0.25
    most_best: int = 3
    second: float = 0.1
    second_of_all: float = 0.005
    described: float = 0.3
    most_stretches: int = 3


FREE_LAWS = FreeLawSettings()
