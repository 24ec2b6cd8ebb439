"""Settings of pruning: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PruningSettings:
    """Thresholds by which effects are rejected after the search.

    They were chosen on simulated development cases, which are none of the blind cases. Floors are
    multiples of a signal's noise floor. Shares are of the squared mismatch of the nominal model.

    Attributes:
        refit_iterations: steps of the refit without an effect.
        doubtful_factor: factor on the required height above the noise floor for an effect in doubt:
            its 95 % interval includes its absence, a shape parameter is at its bound, or only one
            recording shows it and none validates.
        doubt_width: half widths of the 95 % interval around an effect within which its absence
            leaves it in doubt where its joint stays unexplained. A right law is known well there.
        needed_share: share that an effect must explain to be beyond that doubt.
        small_share: share below which an effect with likely alternatives is rejected.
        sure_of_small: confidence from which an effect of a small share stays all the same.
        least_confidence: confidence below which an effect is rejected beside others.
        even: confidence below which alternatives together are more likely than the effect.
        as_likely: part of the likeliest alternative's confidence from which an effect is as likely:
            a difference in evidence of 0.5 decides nothing.
        sure: confidence from which the bound ``left_if_sure`` holds.
        left_if_sure, left_if_unsure: greatest share that may remain where an effect acts.
        left_if_far, far: greatest share if the residual is above so many floors: the right law
            comes closer, however large the mismatch.
        left_if_several, far_if_several: the same for one of several effects at a joint. Wrong
            effects compensate for each other's errors.
        same_dependence: share of the missing force that depends on position once more, from which a
            law of position has the wrong shape.
        position_bins: bins of position and of velocity that this share is computed with.
    """

    refit_iterations: int = 4
    doubtful_factor: float = 2.0
    doubt_width: float = 2.0
    needed_share: float = 0.25
    small_share: float = 0.01
    sure_of_small: float = 0.7
    least_confidence: float = 0.02
    even: float = 0.5
    as_likely: float = 0.6
    sure: float = 0.9
    left_if_sure: float = 0.25
    left_if_unsure: float = 0.2
    left_if_far: float = 0.125
    far: float = 20.0
    left_if_several: float = 0.05
    far_if_several: float = 50.0
    same_dependence: float = 0.25
    position_bins: int = 24


SETTINGS = PruningSettings()
