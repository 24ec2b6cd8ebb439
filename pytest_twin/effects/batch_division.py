"""Division of rows into batches that step together, and of batches over several cores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_MAX_ROWS = 384
"""Largest number of simulations in a batch."""
# Approximate time of a step in s: MuJoCo per joint of a row, Python per batch, and per effect. They
# influence only how work is divided.
_ENGINE_SECONDS, _PYTHON_SECONDS, _EFFECT_SECONDS = 1e-6, 5e-5, 2e-5
_FORK_SECONDS = 0.02
"""Approximate time of a fork, s."""
_MAX_CUTS = 16
"""Positions at which a division of a part is tried, besides those where the effects change."""


@dataclass(frozen=True, slots=True)
class Part:
    """Rows that step together."""

    rows: NDArray[np.int64]
    seconds: float


@dataclass(frozen=True, slots=True)
class _RowSizes:
    """Sizes of rows, from which their time is estimated.

    Attributes:
        steps: (rows,) number of steps.
        laws: (rows, laws) whether an effect acts between the steps.
        joints: joints per row.
    """

    steps: NDArray[np.int64]
    laws: NDArray[np.bool_]
    joints: int

    def part(self, rows: NDArray[np.int64]) -> Part:
        """Return a part with these rows."""
        laws = int(self.laws[rows].any(axis=0).sum())
        python_seconds = _PYTHON_SECONDS + laws * _EFFECT_SECONDS if laws else 0.0
        seconds_per_step = len(rows) * self.joints * _ENGINE_SECONDS + python_seconds
        return Part(rows, float(self.steps[rows].max()) * seconds_per_step)

    def sort_by_laws(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return these rows, sorted by their effects."""
        ordered: NDArray[np.int64] = rows[np.lexsort([rows, *self.laws[rows].T])]
        return ordered

    def divide(self, part: Part, count: int) -> list[Part]:
        """Divide a part into ``count`` parts; rows with the same effects stay together."""
        if count < 2 or len(part.rows) < 2:
            return [part]
        order = self.sort_by_laws(part.rows)
        share = (count // 2) / count
        changes = 1 + np.flatnonzero(np.any(np.diff(self.laws[order], axis=0), axis=1))
        even = np.linspace(1, len(order) - 1, _MAX_CUTS).astype(int)
        middle = np.clip(round(share * len(order)), 1, len(order) - 1)
        places = np.unique([*changes[:: 1 + len(changes) // _MAX_CUTS], *even, middle])
        cuts = [(self.part(order[:at]), self.part(order[at:])) for at in places]
        few, many = min(cuts, key=lambda c: max(c[0].seconds / share, c[1].seconds / (1.0 - share)))
        return self.divide(few, count // 2) + self.divide(many, count - count // 2)


def divide_rows(
    steps: NDArray[np.int64], laws: NDArray[np.bool_], joints: int, cores: int
) -> list[Part]:
    """Divide rows into parts, the longest first.

    Rows of similar length (10 %) step together. Rows without effects between steps form separate
    parts. Larger parts are divided by their effects.

    Args:
        steps: (rows,) number of steps.
        laws: (rows, laws) whether an effect acts between the steps.
        joints: joints per row.
        cores: number of parts at the same time.
    """
    sizes = _RowSizes(steps, laws, joints)
    parts = []
    stepwise: NDArray[np.bool_] = np.asarray(laws.any(axis=1))
    for alike in _group_by_length(steps, stepwise):
        order = sizes.sort_by_laws(alike) if len(alike) > _MAX_ROWS else alike
        parts += [
            sizes.part(order[first : first + _MAX_ROWS])
            for first in range(0, len(order), _MAX_ROWS)
        ]
    return sorted(_divide_among_cores(sizes, parts, cores), key=lambda p: -p.seconds)


def _group_by_length(
    steps: NDArray[np.int64], stepwise: NDArray[np.bool_]
) -> list[NDArray[np.int64]]:
    """Group rows that may step together: similar length, with or without effects between steps."""
    groups: list[NDArray[np.int64]] = []
    for is_stepwise in (False, True):
        rows = np.flatnonzero(stepwise == is_stepwise)
        rows = rows[np.argsort(steps[rows], kind="stable")]
        lengths, begin = steps[rows], 0
        while begin < len(rows):
            longest = 1.1 * lengths[begin] + 8
            end = int(np.searchsorted(lengths, longest, side="right"))
            groups.append(rows[begin:end])
            begin = end
    return groups


def _divide_among_cores(sizes: _RowSizes, parts: Sequence[Part], cores: int) -> list[Part]:
    """Divide parts for the shortest total time on several cores.

    The time between steps does not decrease with the number of rows.
    """
    best, least = list(parts), _total_time(parts, cores)
    if cores == 1 or sum(p.seconds for p in parts) < _FORK_SECONDS:
        return best
    longest = sorted(parts, key=lambda p: -p.seconds)
    divided: list[Part] = []
    for count, part in enumerate(longest, 1):
        divided += sizes.divide(part, cores)
        some = divided + longest[count:]
        seconds = _total_time(some, cores) + _FORK_SECONDS * (cores - 1)
        if seconds < least:
            best, least = some, seconds
    return best


def _total_time(parts: Sequence[Part], cores: int) -> float:
    """Return the time until all parts are done if each free core takes the longest one, s."""
    busy = [0.0] * cores
    for p in sorted(parts, key=lambda p: -p.seconds):
        first = int(np.argmin(busy))
        busy[first] += p.seconds
    return max(busy)


def is_worth_forking(parts: Sequence[Part]) -> bool:
    """Whether several cores save more time than forks cost."""
    return len(parts) > 1 and sum(p.seconds for p in parts) - parts[0].seconds > _FORK_SECONDS
