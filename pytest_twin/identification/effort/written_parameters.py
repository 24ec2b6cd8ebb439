"""Parameters of the fitted model, which is written and tested: bodies and drives that can exist."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.effort.essential_parameters import EssentialParameters
from pytest_twin.identification.effort.instruments import solve_instrumental
from pytest_twin.identification.effort.least_squares import LinearProblem, information, solve
from pytest_twin.identification.effort.stage_comparison import errors_of
from pytest_twin.identification.full_parameters import FullParameters, fit_full_parameters
from pytest_twin.identification.regressor import BaseParameters, Column, Regressor
from pytest_twin.identification.stages import Stage, StageName

_NEAR_ZERO = 10.0
"""Weight of zero for a parameter of links that is not essential, in multiples of the information
about it: it stays within a third of its standard error, as far as bodies can have it."""


@dataclass(frozen=True)
class LinearFit:
    """What the effort says about base parameters.

    Attributes:
        base: base parameters of the fitted joints.
        problem: rows of the fitted recordings, all base columns.
        essential: fit of the essential parameters.
        still: (b,) True for parameters that the motion does not move.
        unsure: (b,) True for parameters that are omitted, but may be as large as nominally.
        stage_of: (b,) stage of each base parameter.
        with_instruments: whether instrumental variables are used.
    """

    base: BaseParameters
    problem: LinearProblem
    essential: EssentialParameters
    still: NDArray[np.bool_]
    unsure: NDArray[np.bool_]
    stage_of: Sequence[StageName]
    with_instruments: bool


def confirm_stages(
    regressor: Regressor,
    fit: LinearFit,
    stages: Sequence[Stage],
    known: Sequence[str],
    tested: LinearProblem,
) -> tuple[FullParameters, tuple[Stage, ...]]:
    """Return the written parameters, and the stages as the written model confirms them.

    A stage that the held-out recordings did not confirm keeps its nominal values only if the
    written model then predicts the held-out efforts at least as well.

    Args:
        stages: stages, each tested with all other parameters free.
        known: joints whose effort is known.
        tested: held-out rows with all columns, or the fitted ones if nothing is held out.
    """

    def written(nominal: frozenset[StageName]) -> FullParameters:
        return written_parameters(regressor.columns, regressor.prior, fit, nominal, known)

    def error(found: FullParameters) -> float:
        errors = errors_of(tested, found.parameters, regressor.joints).values()
        return float(np.mean([one.relative for one in errors]))

    doubtful = frozenset(one.name for one in stages if one.held_out and one.state != "accepted")
    whole = written(frozenset())
    if not doubtful:
        return whole, tuple(stages)
    part = written(doubtful)
    before, after = error(part), error(whole)
    if before <= after:
        return part, tuple(stages)
    why = (
        f"with its nominal values the written model has a held-out error of {100 * before:.3g} "
        f"instead of {100 * after:.3g} %"
    )
    return whole, tuple(
        replace(one, state="accepted", why=f"{one.why}; {why}") if one.name in doubtful else one
        for one in stages
    )


def written_parameters(
    columns: Sequence[Column],
    prior: FloatArray,
    fit: LinearFit,
    rejected: frozenset[StageName],
    known: Sequence[str],
) -> FullParameters:
    """Return the physically consistent parameters nearest to the nominal ones.

    Parameters of rejected stages, and drives whose effort is unknown, keep their nominal values;
    the others are fitted with these. A drive's parameter that is not essential is zero, unless it
    may be as large as nominally.

    Args:
        columns: (p,) description of all parameters.
        prior: (p,) their nominal values.
        rejected: stages that held-out recordings do not confirm.
        known: joints whose effort is known.
    """
    base, count = fit.base, len(fit.base)
    stage = np.array(fit.stage_of)
    of_bodies = np.array([base.columns[i].is_inertial for i in base.independent])
    essential = np.zeros(count, dtype=bool)
    essential[fit.essential.kept] = True
    nominal = np.isin(stage, list(rejected)) | fit.still | (fit.unsure & ~of_bodies)
    if rejected & {"gravity", "inertia"}:
        nominal |= of_bodies
    omitted = ~nominal & ~of_bodies & ~essential
    full, fixed = prior.copy(), np.zeros(len(columns), dtype=bool)
    full[base.independent[omitted]] = 0.0
    fixed[base.independent[omitted | (nominal & ~of_bodies)]] = True
    fixed |= np.array([not c.is_inertial and c.joint not in known for c in columns])
    if (nominal & of_bodies & ~fit.still).any():
        independent = np.isin(np.arange(len(columns)), base.independent[~of_bodies])
        fixed |= ~independent
    free = np.flatnonzero(~nominal & ~omitted)
    constant = np.where(nominal, base.values(prior), 0.0)
    constant[free] = 0.0
    known_effort = fit.problem.matrix @ constant
    rest = replace(
        fit.problem.only(free),
        effort=np.where(fit.problem.known, fit.problem.effort - known_effort, 0.0),
    )
    solution = solve(rest, intervals=False)
    if fit.with_instruments:
        solution = solve_instrumental(rest, solution)
    values, precision = constant, np.zeros((count, count))
    evidence = information(rest, solution.residual, solution.weight)
    measured = evidence.matrix * (
        np.trace(evidence.matrix) / max(float(np.trace(evidence.enlarged)), 1e-300)
    )
    toward_zero = np.where(essential[free], 0.0, _NEAR_ZERO * _own_information(measured))
    information_ = measured + np.diag(toward_zero)
    values[free] = _solved(information_, measured @ solution.values)
    precision[np.ix_(free, free)] = information_
    return fit_full_parameters(columns, full, base.combination, values, precision, fixed)


def _own_information(precision: FloatArray) -> FloatArray:
    """(k,) information about each parameter beside the others: its reciprocal variance."""
    sizes = np.sqrt(np.diag(precision).clip(1e-300))
    variance = np.diag(np.linalg.pinv(precision / np.outer(sizes, sizes), hermitian=True))
    return np.asarray(sizes**2 / np.maximum(variance, 1e-12))


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    sizes = np.sqrt(np.diag(matrix).clip(1e-300))
    unit = matrix / np.outer(sizes, sizes)
    return np.asarray(np.linalg.lstsq(unit, right / sizes, rcond=1e-12)[0] / sizes)
