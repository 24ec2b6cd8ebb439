"""Selection of the variables of a missing force: one table, or a force and a friction."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.unnamed_law.covariates import Covariate, covariates
from pytest_twin.diagnosis.unnamed_law.regression import (
    STRENGTHS,
    Regression,
    log_ratio,
    simplest_within_error,
    standard_error,
)
from pytest_twin.diagnosis.unnamed_law.settings import FREE_LAWS
from pytest_twin.effects.unnamed_law import KNOTS


@dataclass(frozen=True, slots=True)
class JointResidual:
    """The residual that a law at one joint has to explain.

    Attributes:
        linear: the linearization around the findings.
        joint: column of the joint.
        residual: (bins, signals) measured minus predicted.
        weights: (signals,) reciprocal standard deviations.
        recording: (bins,) index of the recording of each bin.
        level: dry friction that the joint already has, N*m or N.
    """

    linear: Linearization
    joint: int
    residual: FloatArray
    weights: FloatArray
    recording: NDArray[np.int64]
    level: float

    def responses(self, covariate: Covariate) -> FloatArray:
        """(bins * signals, KNOTS) weighted responses to unit values at the knots."""
        changes = self.linear.readings.bin_means(covariate.columns(self.joint))
        stacked = np.stack(changes, axis=-1) * self.weights[:, None]
        return stacked.reshape(-1, len(changes)).astype(float)

    def regression(
        self, tables: Sequence[Covariate], responses: FloatArray, residual: FloatArray
    ) -> Regression:
        """The least-squares sums of some tables.

        Args:
            tables: the tables, in the order of the columns of ``responses``.
            responses: (bins * signals, p) weighted responses to the values at all knots.
            residual: (bins, signals) measured minus predicted.
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
class TableFit:
    """Tables at one joint with the penalty that cross-validation chooses.

    Attributes:
        tables: one or two tables.
        responses: (bins * signals, p) weighted responses to the values at the knots.
        strength: the penalty, one of ``STRENGTHS``.
        errors: (recordings,) squared error of each recording with coefficients from the others.
    """

    tables: tuple[Covariate, ...]
    responses: FloatArray
    regression: Regression
    strength: float
    errors: FloatArray

    @property
    def coefficients(self) -> FloatArray:
        """(p,) values at the knots from all recordings, N*m or N."""
        return self.regression.fitted(self.strength)


def choose_strength(
    data: JointResidual, tables: Sequence[Covariate], responses: FloatArray
) -> TableFit:
    """Tables with the strongest penalty whose error is within one standard error of the best."""
    regression = data.regression(tables, responses, data.residual)
    errors = [regression.left_out_errors(s) for s in STRENGTHS]
    k = simplest_within_error(errors)
    return TableFit(tuple(tables), responses, regression, STRENGTHS[k], errors[k])


def rank_tables(data: JointResidual) -> list[TableFit]:
    """A table over each variable, the best first; over a narrow range if the force is local."""
    singles = []
    for covariate in covariates(data.linear, data.joint):
        responses = data.responses(covariate)
        if np.isfinite(responses).all() and responses.any():
            singles.append(choose_strength(data, [covariate], responses))
    order = sorted(singles, key=_error)
    for one in order[: FREE_LAWS.most_best]:
        narrow = _narrow_range(one.tables[0], one.coefficients)
        if narrow is not None:
            other = choose_strength(data, [narrow], data.responses(narrow))
            if _error(other) < _error(one):
                singles[singles.index(one)] = other
    return _simplest_first(singles)


def add_second_table(data: JointResidual, singles: Sequence[TableFit]) -> TableFit:
    """The best single table, or a force and a friction if the second table removes enough."""
    best = singles[0]
    forces, frictions = (
        [c for c in singles if c.tables[0].is_friction is dry][: FREE_LAWS.most_best]
        for dry in (False, True)
    )
    pairs = []
    for a, b in itertools.product(forces, frictions):
        both = np.concatenate([a.responses, b.responses], axis=1)
        pairs.append(choose_strength(data, [*a.tables, *b.tables], both))
    for pair in _simplest_first(pairs)[:1]:
        less = best.errors - pair.errors
        worth = max(
            FREE_LAWS.second * best.errors.sum(),
            FREE_LAWS.second_of_all * best.regression.square.sum(),
        )
        if less.sum() > max(standard_error(less), worth):
            return pair
    return best


def _error(chosen: TableFit) -> float:
    return float(chosen.errors.sum())


def _simplest_first(chosen: Sequence[TableFit]) -> list[TableFit]:
    """Tables by error, after the first in the given order within one standard error of the best."""
    if not chosen:
        return []
    order = sorted(chosen, key=_error)
    for one in chosen:
        more = log_ratio(one.errors, order[0].errors)
        if more.sum() <= standard_error(more):
            return [one, *(c for c in order if c is not one)]
    return order


def _narrow_range(covariate: Covariate, values: FloatArray) -> Covariate | None:
    """The variable with knots only where the force acts; None if it acts over most of the range."""
    mass = values**2 * covariate.occupancy
    total = float(mass.sum())
    if total <= 0.0:
        return None
    reached = np.cumsum(mass) / total
    rest = 0.5 * (1.0 - FREE_LAWS.acts)
    first, last = (int(np.searchsorted(reached, x)) for x in (rest, 1.0 - rest))
    knots = covariate.knots
    low, high = float(knots[first]), float(knots[min(last, KNOTS - 1)])
    room = FREE_LAWS.margin * (high - low) + (knots[1] - knots[0])
    low, high = max(low - room, covariate.low), min(high + room, covariate.high)
    if high - low > FREE_LAWS.narrow * (covariate.high - covariate.low):
        return None
    return replace(covariate, low=low, high=high)
