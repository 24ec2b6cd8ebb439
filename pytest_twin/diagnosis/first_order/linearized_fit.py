"""Fit of all parameters along the measured motion, shape parameters included, without simulation.

It is Levenberg-Marquardt on :meth:`Linearization.differences`: the forces of the laws are exact,
and the resulting deviations are linearized.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import ResidualView
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.effects.batch_division import Part, divide_rows, is_worth_forking
from pytest_twin.estimation.deadline import check_deadline
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import finite_differences, propose_steps, weighted_cost
from pytest_twin.realization.executor import Forks
from pytest_twin.realization.forks import free_cores

# Levenberg-Marquardt damping factors, relative to the diagonal of the normal matrix.
_DAMPINGS = (1e-4, 1e-2, 1.0)
# A fit stops when a step reduces the cost by less than this share.
_CONVERGED = 3e-3
_MAX_ROWS = 48
"""Largest number of rows that are evaluated together if no law is evaluated step by step. More rows
need memory, and save time only where each step has a fixed cost."""


@dataclass(slots=True)
class LinearizedFit:
    """A hypothesis fitted along the measured motion.

    Attributes:
        hypothesis: the present one with more terms; all parameters were fitted.
        residual: (bins, signals) residual of the fit.
    """

    hypothesis: Hypothesis
    residual: FloatArray


def fit_linearized(
    linear: Linearization,
    view: ResidualView,
    starts: Sequence[Hypothesis],
    iterations: int,
    targets: Sequence[FloatArray] | None = None,
) -> list[LinearizedFit]:
    """Fit every start in parallel; each with weights from its own residual.

    Args:
        linear: the linearization along the measured motion.
        starts: hypotheses with starting values.
        iterations: largest number of steps.
        targets: (bins, signals) residual that each hypothesis is fitted to; that of ``view`` by
            default.

    Raises:
        OutOfTime: the time of the search is over.
    """
    if targets is None:
        targets = [view.residual] * len(starts)
    residuals = [t - d for t, d in zip(targets, _differences(linear, starts), strict=True)]
    fits = [LinearizedFit(h, r) for h, r in zip(starts, residuals, strict=True)]
    target = {id(f): t for f, t in zip(fits, targets, strict=True)}
    active = [f for f in fits if f.hypothesis.theta.size]
    # Starts are one hypothesis with a few terms exchanged. Derivatives by the terms that they share
    # are taken once: a quasi-Newton step needs no better ones.
    places = {id(f): _places_of(f.hypothesis) for f in active}
    counts = Counter(place for each in places.values() for place in each)
    shared = dict[_Place, FloatArray]()
    for _ in range(iterations):
        if not active:
            break
        slopes = _slopes(
            linear,
            [f.hypothesis for f in active],
            [target[id(f)] - f.residual for f in active],
            [[p if counts[p] > 1 else None for p in places[id(f)]] for f in active],
            shared,
        )
        weights: list[FloatArray] = []
        tried: list[Hypothesis] = []
        ends = [0]
        for f, slope in zip(active, slopes, strict=True):
            weight = 1.0 / np.sqrt(np.nanmean(f.residual**2, axis=0) + view.floor**2)
            weights.append(weight)
            tried += propose_steps(f.hypothesis, f.residual, slope, weight, _DAMPINGS)
            ends.append(len(tried))
        owner = [f for f, n in zip(active, np.diff(ends), strict=True) for _ in range(n)]
        found = _differences(linear, tried)
        new = [target[id(f)] - d for f, d in zip(owner, found, strict=True)]
        improved = []
        for k, (f, weight) in enumerate(zip(active, weights, strict=True)):
            of_fit = range(ends[k], ends[k + 1])
            best = min(of_fit, key=lambda i: weighted_cost(new[i], weight))
            before, after = weighted_cost(f.residual, weight), weighted_cost(new[best], weight)
            # A smaller gain would only shift parameters along a direction that is not identifiable.
            if after <= (1.0 - _CONVERGED) * before:
                f.hypothesis, f.residual = tried[best], new[best]
                improved.append(f)
        active = improved
    return fits


def linearized_slopes(linear: Linearization, hypotheses: Sequence[Hypothesis]) -> list[FloatArray]:
    """Jacobian of each hypothesis's prediction along the measured motion.

    Returns:
        (bins, signals, parameters) derivatives with respect to the scaled parameters; zero for
        parameters that a fit does not estimate.

    Raises:
        OutOfTime: the time of the search is over.
    """
    here = _differences(linear, hypotheses)
    return _slopes(linear, hypotheses, here, [[None] * h.theta.size for h in hypotheses], {})


_Place = tuple[Term, bytes, int]
"""A term, its parameters, and the index of one of them."""


def _places_of(h: Hypothesis) -> list[_Place]:
    """The place of each parameter."""
    return [
        (t, h.theta[h.slice_of(t)].tobytes(), k) for t in h.terms for k in range(len(t.parameters))
    ]


def _slopes(
    linear: Linearization,
    hypotheses: Sequence[Hypothesis],
    here: Sequence[FloatArray],
    places: Sequence[Sequence[_Place | None]],
    shared: dict[_Place, FloatArray],
) -> list[FloatArray]:
    """(bins, signals, parameters) derivatives of each prediction, by finite differences.

    Args:
        here: (bins, signals) difference that each hypothesis makes.
        places: those parameters of each hypothesis whose derivatives others share.
        shared: known derivatives of such parameters; new ones are added.
    """
    rows, todo, first = list[Hypothesis](), list[tuple[int, int, float]](), set(shared)
    for at, h in enumerate(hypotheses):
        columns = np.flatnonzero(h.is_estimated).tolist()
        for column, row, step in zip(columns, *finite_differences(h), strict=True):
            place = places[at][column]
            if place in first:
                continue
            if place is not None:
                first.add(place)
            rows.append(row)
            todo.append((at, column, step))
    out = [np.zeros((*d.shape, h.theta.size)) for d, h in zip(here, hypotheses, strict=True)]
    for moved, (at, column, step) in zip(_differences(linear, rows), todo, strict=True):
        slope = np.nan_to_num((moved - here[at]) / step, posinf=0.0, neginf=0.0)
        out[at][..., column] = slope
        if (place := places[at][column]) is not None:
            shared[place] = slope
    for slope, each in zip(out, places, strict=True):
        for column, place in enumerate(each):
            if place is not None and place in shared:
                slope[..., column] = shared[place]
    return out


def _differences(linear: Linearization, hypotheses: Sequence[Hypothesis]) -> list[FloatArray]:
    """As :meth:`Linearization.differences`, in batches of hypotheses that need as many steps.

    Raises:
        OutOfTime: the time of the search is over.
    """
    check_deadline()
    laws = sorted({t.effect for h in hypotheses for t in h.terms if t.law.remembers})
    has_law = np.zeros((len(hypotheses), len(laws)), dtype=bool)
    for i, h in enumerate(hypotheses):
        effects = {t.effect for t in h.terms}
        has_law[i] = [law in effects for law in laws]
    segments, samples, joints = linear.trajectory.position.shape
    # Elastic transmissions need the model's time step.
    steps = [
        samples * (linear.trajectory.steps if any(t.law.overrides("gear") for t in h.terms) else 1)
        for h in hypotheses
    ]
    cores = free_cores(linear.simulator.threads)
    parts = divide_rows(np.array(steps), has_law, segments * joints, cores)

    def differences(part: Part) -> list[FloatArray]:
        most = _MAX_ROWS if not has_law[part.rows].any() else len(part.rows)
        some = [hypotheses[i] for i in part.rows]
        return [
            difference
            for first in range(0, len(some), most)
            for difference in linear.differences(some[first : first + most])
        ]

    if not is_worth_forking(parts):
        cores = 1
    if cores > 1:
        linear.precompute_rigid_efforts(hypotheses)
    out: dict[int, FloatArray] = {}
    for part, found in zip(parts, Forks(cores).map(differences, parts), strict=True):
        out.update(zip(part.rows.tolist(), found, strict=True))
    return [out[i] for i in range(len(hypotheses))]
