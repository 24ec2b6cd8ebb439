"""Fit and cross-validate tables by simulation.

The force along the measured motion gives the initial values. The fit then continues with the
residuals of simulations (Gauss-Newton). The same steps without one recording predict that
recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.unnamed_law.covariates import Covariate
from pytest_twin.diagnosis.unnamed_law.regression import Regression
from pytest_twin.diagnosis.unnamed_law.selection import JointResidual, TableFit
from pytest_twin.diagnosis.unnamed_law.settings import FREE_LAWS
from pytest_twin.effects.unnamed_law import TABLES, UnnamedFriction
from pytest_twin.estimation.hypothesis import Hypothesis, Term

_STEPS, _HALVINGS = 4, 3
"""Largest number of Gauss-Newton steps, and of step sizes that are tried in each, which are
halved."""


@dataclass(frozen=True, slots=True)
class SimulatedTables:
    """Tables after simulation.

    Attributes:
        hypothesis: the given hypothesis with the tables.
        coefficients: (p,) coefficients of the tables in their order, N*m or N.
        before, errors: (recordings,) weighted squared error of each recording, simulated without
            tables, and with tables that were fitted to the other recordings.
        left_out: (recordings, p) coefficients without each recording.
        covariance: (p, p) covariance of the coefficients, (N*m)^2 or N^2.
    """

    hypothesis: Hypothesis
    coefficients: FloatArray
    before: FloatArray
    errors: FloatArray
    left_out: FloatArray
    covariance: FloatArray


def with_tables(
    problem: Problem,
    hypothesis: Hypothesis,
    joint: int,
    tables: Sequence[Covariate],
    coefficients: FloatArray,
) -> Hypothesis:
    """Return the hypothesis with these tables instead of the present ones at the joint."""
    removed = [t for t in hypothesis.terms if t.joint == joint and not t.law.candidate]
    out = hypothesis.without(*removed)
    for table, values in zip(tables, np.split(coefficients, len(tables)), strict=True):
        term = Term(table.effect, joint)
        law, others = TABLES[table.effect], {}
        if isinstance(law, UnnamedFriction):
            others["still"] = FREE_LAWS.still * float(problem.scales.of["velocity"][joint])
        parameters = law.parameters_of(
            table.variable, (table.low, table.high), table.valid, values, **others
        )
        theta = [parameters[p.name] / problem.scales.value(p, joint) for p in term.parameters]
        out = out.with_term(term, np.array(theta))
    return out


def fit_tables(
    problem: Problem, hypothesis: Hypothesis, chosen: TableFit, data: JointResidual
) -> SimulatedTables | None:
    """Fit tables by simulation; None if no simulation with them, or no derivative, is finite.

    Args:
        problem: problem with the recordings.
        chosen: tables with their initial values.
        data: linearization and residual around the hypothesis.
    """
    values, regression = chosen.coefficients, chosen.regression
    linear = data.linear
    penalty_matrix = regression.normal(chosen.strength) - regression.gram.sum(axis=0)

    def at(c: FloatArray) -> Hypothesis:
        return with_tables(problem, hypothesis, data.joint, chosen.tables, c)

    def mean_residual(c: FloatArray) -> FloatArray:
        return linear.bins.mean(problem.residuals([at(c)], linear.segments)[0])

    def objective(residual: FloatArray, c: FloatArray) -> float:
        return float(np.sum((residual * data.weights) ** 2) + c @ penalty_matrix @ c)

    # If the whole force is too large for the linearization, a part of it is a better start.
    for share in (1.0, 0.5, 0.25):
        residual = mean_residual(share * values)
        if np.isfinite(best := objective(residual, share * values)):
            values = share * values
            break
    else:
        return None
    local: Regression | None = None
    for _ in range(_STEPS):
        local_regression = _linearize_around(
            problem, at(values), data, chosen.tables, residual, values
        )
        if not np.isfinite(local_regression.gram).all():
            # The linearized motion diverges, but the simulated one does not.
            break
        local = local_regression
        step = local.fitted(chosen.strength) - values
        for _ in range(_HALVINGS):
            tried = values + step
            there = mean_residual(tried)
            size = objective(there, tried)
            if size < best:
                break
            step = 0.5 * step
        else:
            break
        gained, values, residual, best = best - size, tried, there, size
        if gained < FREE_LAWS.least_step * best:
            break
    if local is None:
        return None
    recordings = np.unique(data.recording)
    # Change of the values without each recording, from the last step.
    whole = local.fitted(chosen.strength)
    left_out = np.array([
        values + local.fitted(chosen.strength, r) - whole for r in range(len(recordings))
    ])  # fmt: skip
    errors = np.array([
        _error(problem, at(c), data, r) for c, r in zip(left_out, recordings, strict=True)
    ])  # fmt: skip
    before = np.array([_error(problem, hypothesis, data, r) for r in recordings])
    return SimulatedTables(
        at(values), values, before, errors, left_out, _covariance(local, chosen.strength, values)
    )


def _linearize_around(
    problem: Problem,
    hypothesis: Hypothesis,
    data: JointResidual,
    tables: Sequence[Covariate],
    residual: FloatArray,
    values: FloatArray,
) -> Regression:
    """Return the least-squares sums of a step from ``values``."""
    linear = Linearization(problem, hypothesis, data.linear.segments)
    columns = [
        c for t in tables for c in t.for_linearization(linear, data.joint).columns(data.joint)
    ]
    changes = linear.readings.bin_means(columns)
    responses = np.stack(changes, axis=-1) * data.weights[:, None]
    flat = responses.reshape(-1, len(changes)).astype(float)
    whole = residual + (flat @ values).reshape(residual.shape) / data.weights
    return data.regression(tables, flat, whole)


def _error(problem: Problem, hypothesis: Hypothesis, data: JointResidual, recording: int) -> float:
    """Weighted squared error of one recording in the simulation."""
    linear, bins = data.linear, data.linear.bins
    owner = np.repeat(np.arange(len(bins.lengths)), bins.lengths)
    mine = np.unique(owner[data.recording == recording])
    segments = linear.segments[mine]
    residual = problem.residuals([hypothesis], segments)[0]
    counts = bins.counts[np.isin(owner, mine)]
    edges = np.concatenate([[0], np.cumsum(counts)[:-1]])
    mean = np.add.reduceat(residual, edges, axis=0) / counts[:, None]
    return float(np.sum((mean * data.weights) ** 2))


def _covariance(local: Regression, strength: float, values: FloatArray) -> FloatArray:
    """Sandwich covariance of the coefficients, from scores of recordings (Liang, Zeger 1986)."""
    inverse = np.linalg.inv(local.normal(strength))
    scores = local.moment - local.gram @ values
    count = len(scores)
    meat = scores.T @ scores * (count / max(count - 1, 1))
    clustered: FloatArray = inverse @ meat @ inverse
    return clustered
