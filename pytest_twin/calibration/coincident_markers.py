"""Exclude markers that a tracker reports at the position of another marker."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from pytest_twin.calibration.observations import Observations

COINCIDENT_M = 1e-4
"""Distance below which two markers coincide. The smallest markers on the market have a diameter of
1.5 mm."""


@dataclass(frozen=True)
class ExcludedMeasurement:
    """A measurement that is left out of the calibration.

    Attributes:
        id: id of the observation, or ``point.NAME`` for all observations of a marker.
        why: reason, as text.
    """

    id: str
    why: str

    def to_json(self) -> dict[str, str]:
        """Return the entry of ``calibration.json``."""
        return {"id": self.id, "why": self.why}


def without_coincident(
    observations: Observations,
) -> tuple[Observations, tuple[ExcludedMeasurement, ...]]:
    """Return the observations without coincident markers, and what was left out.

    If two markers coincide in every row, the first is kept. If they coincide in some rows only, the
    marker is kept whose distances to the other markers agree with those of the other rows. If the
    distances do not decide it, neither is kept.
    """
    points = {name: values.copy() for name, values in observations.points.items()}
    left_out: list[ExcludedMeasurement] = []
    for first, second in combinations(tuple(points), 2):
        gap = np.linalg.norm(points[first] - points[second], axis=1)
        both = np.isfinite(gap)
        same = both & (gap < COINCIDENT_M)
        if not same.any():
            continue
        if (same | ~both).all():
            points[second][same] = np.nan
            left_out.append(
                ExcludedMeasurement(
                    f"point.{second}",
                    f"markers {first} and {second} are at the same place in all {int(same.sum())} "
                    f"rows: one was lost and filled in; counted once, as {first}",
                )
            )
            continue
        for row in np.flatnonzero(same):
            wrong = _misplaced_markers(points, first, second, int(row), same)
            for name in wrong:
                points[name][row] = np.nan
            who = f"marker {wrong[0]} is" if len(wrong) == 1 else "both are"
            left_out.append(
                ExcludedMeasurement(
                    observations.ids[row],
                    f"markers {first} and {second} are at the same place ({1e3 * gap[row]:.3f} mm "
                    f"apart): {who} left out of this row",
                )
            )
    return replace(observations, points=points), tuple(left_out)


def _misplaced_markers(
    points: dict[str, np.ndarray], first: str, second: str, row: int, same: np.ndarray
) -> tuple[str, ...]:
    """Return which of two coincident markers are not at their position on the body."""
    others = [name for name in points if name not in (first, second)]
    error = {first: 0.0, second: 0.0}
    for name in others:
        for mine in (first, second):
            gap = np.linalg.norm(points[mine] - points[name], axis=1)
            usual = float(np.nanmedian(gap[~same])) if np.isfinite(gap[~same]).any() else np.nan
            if np.isfinite(usual) and np.isfinite(gap[row]):
                error[mine] += abs(float(gap[row]) - usual)
    smaller, larger = sorted(error.values())
    if larger < 10.0 * max(smaller, COINCIDENT_M):
        return first, second
    return (first,) if error[first] > error[second] else (second,)
