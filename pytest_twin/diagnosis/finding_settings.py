"""Settings of reported findings: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FindingSettings:
    """Thresholds on confidences, alternatives and intervals that are reported.

    They were chosen on simulated development cases, so that a confidence is the share of right
    names. Floors are multiples of a signal's noise floor.

    Attributes:
        most_without_held_out: greatest confidence without held-out recordings.
        least_listed: confidence above which an alternative is listed.
        same_prediction: floors by which the predictions of an alternative may differ for it to be
            listed with any confidence.
        most_alternatives: alternatives that are listed.
        correlated: correlation of two parameters from which only a combination of them is known.
        most_in_doubt: greatest confidence with a parameter at its physical bound, or at a joint
            whose encoder is stuck.
        chance: share of the squared held-out error by which it may grow by chance.
        soon: s after the start of a window under effort commands in which the effect of a finding
            is measured. Later the open-loop error of any change dominates.
        moves_motions: factor on the residual by which a finding must move whole motions to be
            ranked by that: motions that diverged differ from each other as much as from a third.
        unbounded: factor on the known end of an interval at which its open end is reported, where
            the interval of a reciprocal reaches zero.
        most_uncompared: largest confidence of an effect if its set was not compared with others. In
            three of ten recordings of real machines, a wrong effect had 92 to 100 % without the
            comparison.
        most_unexplained: largest confidence of an effect at a joint with a residual on the
            held-out recordings. Of six such names at 90 % and above in blind cases, three were
            right; of nine at joints without a residual, seven.
        idle: a parameter is idle if it changes the prediction by less than this number of floors.
    """

    most_without_held_out: float = 0.8
    least_listed: float = 1e-4
    same_prediction: float = 1.5
    most_alternatives: int = 4
    correlated: float = 0.9
    most_in_doubt: float = 0.5
    chance: float = 0.01
    soon: float = 0.25
    moves_motions: float = 2.0
    unbounded: float = 1e3
    most_uncompared: float = 0.8
    most_unexplained: float = 0.8
    idle: float = 0.5


FINDINGS = FindingSettings()
