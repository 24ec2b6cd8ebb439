"""Settings of reported findings: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FindingSettings:
    """Thresholds on confidences, alternatives and intervals that are reported.

    Floors are multiples of a signal's noise floor.

    Attributes:
        most_without_held_out: greatest confidence without held-out recordings. Parts of one
            recording share its motion and its disturbances, so they are no independent repetition:
            at least one chance in ten is left to an effect that only this motion imitates.
        least_listed: confidence above which an alternative is listed.
        same_prediction: floors by which the predictions of an alternative may differ for it to be
            listed with any confidence.
        most_alternatives: alternatives that are listed.
        correlated: correlation of two parameters from which only a combination of them is known.
        most_in_doubt: greatest confidence with a parameter at its physical bound, at a joint whose
            encoder is stuck, or if no other effect was compared: even odds of the effect and of
            what nobody looked at.
        chance: share of the squared held-out error by which it may grow by chance.
        soon: s after the start of a window under effort commands in which the effect of a finding
            is measured. Later the open-loop error of any change dominates.
        moves_motions: factor on the residual by which a finding must move whole motions to be
            ranked by that: motions that diverged differ from each other as much as from a third.
        unbounded: factor on the known end of an interval at which its open end is reported, where
            the interval of a reciprocal reaches zero.
        idle: a parameter is idle if it changes the prediction by less than this number of floors.
    """

    most_without_held_out: float = 0.9
    least_listed: float = 1e-4
    same_prediction: float = 1.5
    most_alternatives: int = 4
    correlated: float = 0.9
    most_in_doubt: float = 0.5
    chance: float = 0.01
    soon: float = 0.25
    moves_motions: float = 2.0
    unbounded: float = 1e3
    idle: float = 0.5


FINDINGS = FindingSettings()
