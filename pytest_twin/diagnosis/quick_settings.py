"""Settings of the quick diagnosis: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class QuickSettings:
    """Bounds and thresholds of the quick diagnosis.

    They were chosen so that a failing replay golden has its likely cause within about 10 s, on
    simulated development cases. Floors are multiples of a signal's noise floor.

    Attributes:
        looked_at: s of a longer recording that are used, around its worst error.
        stretch_share: share of ``looked_at`` over which candidates are simulated.
        shortest, longest: s of that stretch.
        cause: missing force of a joint, as a share of the largest, from which its effects are
            tried: other joints only move because of it.
        most_joints: joints whose effects are tried.
        candidates: models that are fitted by simulation.
        iterations: steps of each fit.
        removes: share of the squared error that an effect must remove.
        clearly_worse: factor on the squared error of the best model, or on the squared noise floor
            where that is larger, up to which an alternative is listed.
        most_alternatives: alternatives that are listed.
        most_rounds: searches, each at the joints that the effects before do not explain.
        coarse: share of the nominal error below which the residual of a short fit supports no
            effect.
        most_confidence: greatest confidence: one stretch of one recording settles nothing.
        state_seconds: s over which the initial velocity is estimated.
    """

    looked_at: float = 20.0
    stretch_share: float = 0.15
    shortest: float = 1.0
    longest: float = 2.5
    cause: float = 0.4
    most_joints: int = 2
    candidates: int = 5
    iterations: int = 3
    removes: float = 0.3
    clearly_worse: float = 3.0
    most_alternatives: int = 2
    most_rounds: int = 3
    coarse: float = 0.05
    most_confidence: float = 0.9
    state_seconds: float = 0.06


QUICK = QuickSettings()
