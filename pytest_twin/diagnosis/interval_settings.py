"""Settings of confidence intervals: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class IntervalSettings:
    """Thresholds of the jackknife over recordings, from which intervals follow.

    They were chosen so that 95 % of the intervals of simulated cases contain the true value.

    Attributes:
        fewest_clusters: smallest number of clusters for a jackknife.
        parts: number of parts that fewer recordings are cut into.
        most_leverage: largest share of the information on a parameter that one cluster may have.
        least_variance: smallest share of the variance that a combination of parameters may have: it
            is assumed to be at most ten times as accurate as each of them.
    """

    fewest_clusters: int = 3
    parts: int = 6
    most_leverage: float = 0.9
    least_variance: float = 0.01


INTERVALS = IntervalSettings()
