"""Which variables a missing force depends on: one, or a force and a friction."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.sensitivities import Linear
from pytest_twin.diagnosis.unnamed_law.covariates import Covariate, covariates
from pytest_twin.diagnosis.unnamed_law.regression import (
    STRENGTHS,
    Regression,
    log_ratio,
    simplest,
    standard_error,
)
from pytest_twin.effects.unnamed_law import KNOTS

# A table is moved to where its force acts if that is less than half of its range; the margin is in
# shares of the new range.
_ACTS, _NARROW, _MARGIN = 0.98, 0.5, 0.25
# Singles that are tried over a narrow range, too.
_FOREMOST = 3
_SECOND, _SECOND_OF_ALL = 0.1, 0.005
"""Shares of the remaining error, and of all error, that a second table must remove."""


@dataclass(frozen=True, slots=True)
class Data:
    """What is to be explained at one joint, and to what weights.

    Attributes:
        linear: around the hypothesis.
        joint: column.
        residual: (bins, signals) measured minus predicted.
        weights: (signals,) reciprocal deviations.
        recording: (bins,) number of the recording of each.
        level: dry friction at the joint already, N*m or N.
    """

    linear: Linear
    joint: int
    residual: FloatArray
    weights: FloatArray
    recording: NDArray[np.int64]
    level: float

    def responses(self, covariate: Covariate) -> FloatArray:
        """(bins * signals, KNOTS) weighted responses to unit values at the knots."""
        changes = self.linear.readings.of(covariate.columns(self.joint))
        stacked = np.stack(changes, axis=-1) * self.weights[:, None]
        return stacked.reshape(-1, len(changes)).astype(float)

    def regression(
        self, tables: Sequence[Covariate], responses: FloatArray, residual: FloatArray
    ) -> Regression:
        """The sums of these tables.

        Args:
            tables: in their order.
            responses: (bins * signals, p) weighted, of all tables.
            residual: (bins, signals).
        """
        target = (residual * self.weights).ravel()
        owner = np.repeat(self.recording, len(self.weights))
        each = [owner == r for r in np.unique(self.recording)]
        lower = np.concatenate([
            np.full(KNOTS, -self.level if t.is_friction else -np.inf)
            for t in tables
        ])  # fmt: skip
        return Regression(
            np.array([responses[i].T @ responses[i] for i in each]),
            np.array([responses[i].T @ target[i] for i in each]),
            np.array([target[i] @ target[i] for i in each]),
            lower,
            len(tables),
        )


@dataclass(frozen=True, slots=True)
class Chosen:
    """Tables at one joint, as cross-validation has them.

    Attributes:
        tables: one or two.
        responses: (bins * signals, p) weighted.
        regression: its sums.
        strength: of the penalty.
        errors: (recordings,) squared error of each, predicted from the others.
    """

    tables: tuple[Covariate, ...]
    responses: FloatArray
    regression: Regression
    strength: float
    errors: FloatArray

    @property
    def coefficients(self) -> FloatArray:
        """(p,) from all recordings."""
        return self.regression.fitted(self.strength)


def judged(data: Data, tables: Sequence[Covariate], responses: FloatArray) -> Chosen:
    """Tables with the strongest penalty that predicts within one standard error of the best."""
    regression = data.regression(tables, responses, data.residual)
    errors = [regression.left_out_errors(s) for s in STRENGTHS]
    k = simplest(errors)
    return Chosen(tuple(tables), responses, regression, STRENGTHS[k], errors[k])


def ranked(data: Data) -> list[Chosen]:
    """One table over each variable, the best first, over a narrow range where it acts in one."""
    singles = []
    for covariate in covariates(data.linear, data.joint):
        responses = data.responses(covariate)
        if np.isfinite(responses).all() and responses.any():
            singles.append(judged(data, [covariate], responses))
    order = sorted(singles, key=_error)
    for one in order[:_FOREMOST]:
        narrow = _narrowed(one.tables[0], one.coefficients)
        if narrow is not None:
            other = judged(data, [narrow], data.responses(narrow))
            if _error(other) < _error(one):
                singles[singles.index(one)] = other
    return _simplest_first(singles)


def with_second(data: Data, singles: Sequence[Chosen]) -> Chosen:
    """The best single table, or a force and a friction where the second is worth it."""
    best = singles[0]
    forces, frictions = (
        [c for c in singles if c.tables[0].is_friction is dry][:_FOREMOST] for dry in (False, True)
    )
    pairs = []
    for a, b in itertools.product(forces, frictions):
        both = np.concatenate([a.responses, b.responses], axis=1)
        pairs.append(judged(data, [*a.tables, *b.tables], both))
    for pair in _simplest_first(pairs)[:1]:
        less = best.errors - pair.errors
        worth = max(_SECOND * best.errors.sum(), _SECOND_OF_ALL * best.regression.square.sum())
        if less.sum() > max(standard_error(less), worth):
            return pair
    return best


def _error(chosen: Chosen) -> float:
    return float(chosen.errors.sum())


def _simplest_first(chosen: Sequence[Chosen]) -> list[Chosen]:
    """The best first; before it the first in the given order that is within one standard error."""
    if not chosen:
        return []
    order = sorted(chosen, key=_error)
    for one in chosen:
        more = log_ratio(one.errors, order[0].errors)
        if more.sum() <= standard_error(more):
            return [one, *(c for c in order if c is not one)]
    return order


def _narrowed(covariate: Covariate, values: FloatArray) -> Covariate | None:
    """The same variable with knots where the force acts alone; None where that is everywhere."""
    mass = values**2 * covariate.occupancy
    total = float(mass.sum())
    if total <= 0.0:
        return None
    reached = np.cumsum(mass) / total
    rest = 0.5 * (1.0 - _ACTS)
    first, last = (int(np.searchsorted(reached, x)) for x in (rest, 1.0 - rest))
    knots = covariate.knots
    low, high = float(knots[first]), float(knots[min(last, KNOTS - 1)])
    room = _MARGIN * (high - low) + (knots[1] - knots[0])
    low, high = max(low - room, covariate.low), min(high + room, covariate.high)
    if high - low > _NARROW * (covariate.high - covariate.low):
        return None
    return replace(covariate, low=low, high=high)
