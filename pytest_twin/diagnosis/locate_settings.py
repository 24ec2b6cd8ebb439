"""Settings of the localization of a residual: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LocateSettings:
    """Thresholds by which a residual is located in time, in regimes and in frequency.

    They were chosen for the words of a report on simulated development cases; no finding depends on
    them.

    Attributes:
        window: s over which the squared error is smoothed.
        merge: s between two windows up to which they are one.
        cover: share of the squared error that the windows contain.
        most_windows: largest number of windows that a report lists.
        touching: largest distance to a surface of the model that is treated as contact, m.
        still: share of the largest speed below which a joint is at rest.
        lift: factor by which a regime's share of the error must exceed its share of the time.
        share: share of the error that a regime must contain.
        edges: ends that an interval of positions is chosen from.
        searched: factor on the score of an interval of positions: its ends were fitted, so it
            scores higher by chance.
        most_values: values of a metadata key that are regimes. More values are names of recordings
            or temperatures.
        cause: a joint is a cause from this share of the largest signal-to-noise ratio of missing
            forces. The others only move because of it.
    """

    window: float = 0.1
    merge: float = 0.25
    cover: float = 0.8
    most_windows: int = 12
    touching: float = 0.01
    still: float = 0.02
    lift: float = 1.5
    share: float = 0.45
    edges: int = 33
    searched: float = 0.8
    most_values: int = 6
    cause: float = 0.4


LOCATE = LocateSettings()
