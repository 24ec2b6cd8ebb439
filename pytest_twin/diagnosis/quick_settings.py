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
        removes: share of the squared error that an effect must remove.
        most_alternatives: alternatives that are listed.
        rounds: rounds of the search, each of which accepts at most one model.
        most_confidence: greatest confidence: one stretch of one recording settles nothing.
            Alternatives with the rest are listed.
        state_seconds: s over which the initial velocity is estimated.
    """

    looked_at: float = 20.0
    stretch_share: float = 0.15
    shortest: float = 1.0
    longest: float = 2.5
    cause: float = 0.4
    most_joints: int = 2
    removes: float = 0.3
    most_alternatives: int = 2
    rounds: int = 2
    most_confidence: float = 0.9
    state_seconds: float = 0.06


QUICK = QuickSettings()
