"""Whether a series of sessions changes, by a step or a drift, and its probability by chance.

The statistic is the largest t value over all possible changes (sup-F test: Andrews, Econometrica
61, 1993). Its distribution without a change is simulated for the very dates, weights and declared
differences of the series (Monte Carlo test: Barnard 1963), so that it holds for few sessions too,
and for the tails of the scatter that all series of the robot show.
Further steps are sought with the earlier ones declared (Bai, Perron, Econometrica 66, 1998).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.trend.tails import NORMAL, drawn

Kind = Literal["step", "drift"]
_DRAWS = 9999
"""Number of simulated series without a change; the smallest probability is one in 10,000."""
_MOST_CHANGES = 3
"""Largest number of changes of one series."""
_ALIKE = 2.0
"""Ratio of the weights of two sessions up to which all count alike."""
_LEFT = 1e-9
"""Share of a column that declared differences must leave for it to be a change of its own."""


@dataclass(frozen=True)
class ChangePoint:
    """One change of a series.

    Attributes:
        kind: ``step`` between two sessions, or ``drift`` over all dates.
        after: index of the first session after a step; 0 for a drift.
        size: change of the value: at the step, or from the first to the last date.
        std: its standard deviation, by the scatter of the sessions.
        probability: of a change at least as clear in any of the series, if nothing changes.
    """

    kind: Kind
    after: int
    size: float
    std: float
    probability: float


@dataclass(frozen=True)
class Alarm:
    """What counts as a change.

    Attributes:
        level: probability of a change in any of the series if nothing changes.
        series: number of series among which one change is sought.
        tails: degrees of freedom of the t law of the sessions' scatter.
    """

    level: float
    series: int
    tails: float = NORMAL


def changes_of(
    value: FloatArray,
    std: FloatArray,
    date: FloatArray,
    declared: FloatArray,
    alarm: Alarm,
    tolerated: float = 0.0,
) -> list[ChangePoint]:
    """Changes of a series, in the order in which they are found.

    Args:
        value, std: (n,) estimates and their standard deviations.
        date: (n,) time, increasing, any unit.
        declared: (n, q) declared differences, such as temperature; what they explain is no change.
        alarm: what counts as a change.
        tolerated: size of a change that the warm-up of a session explains.
    """
    weight = _weights(value, std)
    found: list[ChangePoint] = []
    known = declared
    for _ in range(_MOST_CHANGES):
        columns, kinds, after = _possible(date)
        test = _Test.of(columns, known, weight, alarm.tails)
        if test is None:
            break
        t, size, error = test.of_series(value, tolerated)
        best = int(np.argmax(t))
        by_chance = test.probability(float(t[best]))
        probability = 1.0 - (1.0 - by_chance) ** alarm.series
        if probability > alarm.level:
            break
        found.append(
            ChangePoint(
                kinds[best], after[best], float(size[best]), float(error[best]), probability
            )
        )
        known = np.column_stack([known, columns[:, best]])
    return found


def _weights(value: FloatArray, std: FloatArray) -> FloatArray:
    """(n,) weights of sessions: scatter between them, and the deviation of each estimate.

    The scatter is that of successive differences, which one step hardly changes (von Neumann
    1941); with it a session whose motion shows the parameter badly counts less.
    """
    between = 0.5 * float(np.median(np.diff(value) ** 2)) / 0.455
    spread: FloatArray = np.maximum(between, 1e-30) + np.maximum(std, 0.0) ** 2
    weights: FloatArray = 1.0 / spread
    if weights.max() < _ALIKE * weights.min():
        return np.ones(len(value))
    return np.asarray(weights / weights.mean())


def _possible(date: FloatArray) -> tuple[FloatArray, list[Kind], list[int]]:
    """(n, m) columns of all possible changes, their kinds, and the first session after each."""
    count = len(date)
    steps = [(np.arange(count) >= k).astype(float) for k in range(1, count)]
    drift = (date - date[0]) / max(float(date[-1] - date[0]), 1e-12)
    columns = np.column_stack([*steps, drift])
    kinds: list[Kind] = ["step"] * len(steps)
    return columns, [*kinds, "drift"], [*range(1, count), 0]


def detectable(value: FloatArray, std: FloatArray, declared: FloatArray, alarm: Alarm) -> float:
    """Size of a step in the middle of a series that is found with a probability of one half.

    Arguments are as for :func:`changes_of`; infinite if no step can be found.
    """
    middle = (np.arange(len(value)) >= len(value) // 2).astype(float)
    test = _Test.of(
        _possible(np.arange(len(value), dtype=float))[0],
        declared,
        _weights(value, std),
        alarm.tails,
    )
    if test is None:
        return float("inf")
    by_chance = 1.0 - (1.0 - alarm.level) ** (1.0 / alarm.series)
    rank = int(np.ceil((len(test.null) + 1) * (1.0 - by_chance))) - 1
    at = int(np.argmax(middle)) - 1
    if rank >= len(test.null) or not test.columns[:, at].any():
        return float("inf")
    # The scatter without the clearest change, so that a change does not hide itself.
    t, _, error = test.of_series(value, 0.0)
    return float(test.null[rank] * error[int(np.argmax(t))] * test.length[int(np.argmax(t))]
                 / test.length[at])  # fmt: skip


@dataclass(frozen=True)
class _Test:
    """Projections of the largest t value for one design.

    Attributes:
        root: (n,) square roots of the weights.
        declared: (n, q) orthonormal basis of the constant and the declared differences, weighted.
        columns: (n, m) weighted columns without what is declared, of length 1; 0 where nothing of
            them remains.
        length: (m,) their length before.
        null: sorted largest t values without a change.
    """

    root: FloatArray
    declared: FloatArray
    columns: FloatArray
    length: FloatArray
    null: FloatArray

    @classmethod
    def of(
        cls, columns: FloatArray, declared: FloatArray, weight: FloatArray, tails: float
    ) -> _Test | None:
        """The test; None if too few sessions remain for it."""
        root = np.sqrt(weight)
        constant = np.column_stack([np.ones(len(weight)), declared]) * root[:, None]
        left, sizes, _ = np.linalg.svd(constant, full_matrices=False)
        basis = left[:, sizes > _LEFT * sizes.max()]
        if len(weight) - basis.shape[1] < 2:
            return None
        weighted = columns * root[:, None]
        before = np.linalg.norm(weighted, axis=0)
        weighted = weighted - basis @ (basis.T @ weighted)
        length = np.linalg.norm(weighted, axis=0)
        unit = np.where(length > _LEFT * before, weighted / np.maximum(length, 1e-300), 0.0)
        null = _null(basis.tobytes(), basis.shape, unit.tobytes(), unit.shape, tails)
        return cls(root, basis, unit, length, null)

    def of_series(
        self, value: FloatArray, tolerated: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(m,) absolute t value, size and standard deviation of each possible change."""
        weighted = value * self.root
        left = weighted - self.declared @ (self.declared.T @ weighted)
        along = self.columns.T @ left
        freedom = len(value) - self.declared.shape[1] - 1
        rest = np.sqrt(np.maximum(float(left @ left) - along**2, 1e-300) / freedom)
        size = along / np.maximum(self.length, 1e-300)
        error = rest / np.maximum(self.length, 1e-300)
        beyond = np.maximum(np.abs(size) - tolerated, 0.0)
        return beyond / np.maximum(error, 1e-300), size, error

    def probability(self, t: float) -> float:
        """Probability of a largest t value of at least ``t`` without a change."""
        above = len(self.null) - int(np.searchsorted(self.null, t, side="left"))
        return (1.0 + above) / (1.0 + len(self.null))


@lru_cache(maxsize=256)
def _null(
    basis: bytes,
    basis_shape: tuple[int, ...],
    unit: bytes,
    unit_shape: tuple[int, ...],
    tails: float,
) -> FloatArray:
    """Sorted largest t values of series of independent values of one t law."""
    declared = np.frombuffer(basis).reshape(basis_shape)
    columns = np.frombuffer(unit).reshape(unit_shape)
    values = drawn(np.random.default_rng(0), tails, (_DRAWS, basis_shape[0]))
    left = values - (values @ declared) @ declared.T
    along = left @ columns
    freedom = basis_shape[0] - basis_shape[1] - 1
    rest = np.maximum((left**2).sum(axis=1)[:, None] - along**2, 1e-300) / max(freedom, 1)
    largest: FloatArray = np.sort((np.abs(along) / np.sqrt(rest)).max(axis=1))
    return largest


def switches_between_levels(value: FloatArray) -> int:
    """How often a series switches between two levels that explain nearly all of its scatter.

    Two robots, tools or controllers in one history do this; 0 where there are no two levels.
    """
    order = np.sort(value)
    total = float(((order - order.mean()) ** 2).sum())
    if total <= 0.0 or len(value) < _FEWEST_FOR_LEVELS:
        return 0
    within = [
        float(((order[:k] - order[:k].mean()) ** 2).sum())
        + float(((order[k:] - order[k:].mean()) ** 2).sum())
        for k in range(2, len(order) - 1)
    ]
    best = int(np.argmin(within))
    if within[best] > _TWO_LEVELS * total:
        return 0
    high = value >= order[best + 2]
    return int((np.diff(high.astype(int)) != 0).sum())


_TWO_LEVELS = 0.05
"""Share of the scatter within two levels below which a series has two levels. Of 16,000 series of
20 normal values none leaves so little."""
_FEWEST_FOR_LEVELS = 12
"""Fewest sessions for it: of series of 8 normal values, one in 200 leaves so little."""


def declared_steps(dates: Sequence[float], sessions: FloatArray) -> FloatArray:
    """(n, q) columns of declared events: 0 before and 1 after each; those within all sessions."""
    columns = [(sessions >= date).astype(float) for date in dates]
    inside = [column for column in columns if 0.0 < column.mean() < 1.0]
    return np.column_stack(inside) if inside else np.zeros((len(sessions), 0))
