"""Fit of all parameters along the measured motion, shape parameters included, without simulation.

It is Levenberg-Marquardt on :meth:`Linearization.differences`: the forces of the laws are exact,
and the resulting deviations are linearized.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import ResidualView
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.estimation.deadline import check_deadline
from pytest_twin.estimation.hypothesis import Hypothesis
from pytest_twin.estimation.least_squares import finite_differences, propose_steps, weighted_cost
from pytest_twin.realization.executor import Forks
from pytest_twin.realization.forks import free_cores

# Levenberg-Marquardt damping factors, relative to the diagonal of the normal matrix.
_DAMPINGS = (1e-4, 1e-2, 1.0)
# A fit stops when a step reduces the cost by less than this share.
_CONVERGED = 3e-3
_MIN_ROWS, _MAX_ROWS, _MAX_STEPWISE_ROWS = 4, 48, 384
"""Smallest and largest number of rows in a batch, and largest number if the laws are evaluated step
by step. A process costs more than few rows. More rows need memory, and save time only where each
step has a fixed cost."""


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
    for _ in range(iterations):
        if not active:
            break
        perturbations = [finite_differences(f.hypothesis) for f in active]
        moved = iter(_differences(linear, [row for rows, _ in perturbations for row in rows]))
        weights: list[FloatArray] = []
        tried: list[Hypothesis] = []
        ends = [0]
        for f, (_, steps) in zip(active, perturbations, strict=True):
            weight = 1.0 / np.sqrt(np.nanmean(f.residual**2, axis=0) + view.floor**2)
            here = target[id(f)] - f.residual
            slope = np.zeros((*here.shape, f.hypothesis.theta.size))
            for column, s in zip(np.flatnonzero(f.hypothesis.is_estimated), steps, strict=True):
                slope[..., column] = (next(moved) - here) / s
            slope = np.nan_to_num(slope, posinf=0.0, neginf=0.0)
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
    perturbations = [finite_differences(h) for h in hypotheses]
    here = _differences(linear, hypotheses)
    moved = iter(_differences(linear, [row for rows, _ in perturbations for row in rows]))
    out = []
    for h, base, (_, steps) in zip(hypotheses, here, perturbations, strict=True):
        slope = np.zeros((*base.shape, h.theta.size))
        for column, step in zip(np.flatnonzero(h.is_estimated), steps, strict=True):
            slope[..., column] = (next(moved) - base) / step
        out.append(np.nan_to_num(slope, posinf=0.0, neginf=0.0))
    return out


def _differences(linear: Linearization, hypotheses: Sequence[Hypothesis]) -> list[FloatArray]:
    """As :meth:`Linearization.differences`, in batches of hypotheses that need the same time step.

    Raises:
        OutOfTime: the time of the search is over.
    """
    check_deadline()
    groups: dict[tuple[bool, bool], list[int]] = {}
    for i, h in enumerate(hypotheses):
        effects = [t.law for t in h.terms]
        key = (
            any(e.remembers for e in effects),
            any(e.overrides("gear") for e in effects),
        )
        groups.setdefault(key, []).append(i)
    cores = free_cores(linear.simulator.threads)
    batches = []
    # Hypotheses that need the model's time step take longest and come first.
    for key in sorted(groups, key=lambda k: (k[1], k[0]), reverse=True):
        # Every law of a batch is evaluated for all its hypotheses: those with equal laws share one.
        which = sorted(groups[key], key=lambda i: sorted(t.effect for t in hypotheses[i].terms))
        most = _MAX_STEPWISE_ROWS if key[0] else _MAX_ROWS
        each = min(most, max(-(-len(which) // cores), _MIN_ROWS))
        batches += [which[i : i + each] for i in range(0, len(which), each)]
    if cores > 1:
        linear.precompute_rigid_efforts(hypotheses)
    differences = Forks(cores).map(
        linear.differences, [[hypotheses[i] for i in some] for some in batches]
    )
    out: dict[int, FloatArray] = {}
    for some, found in zip(batches, differences, strict=True):
        out.update(zip(some, found, strict=True))
    return [out[i] for i in range(len(hypotheses))]
