"""Fits of simulated models: along the linearized motion, corrected by simulation, by simulation.

The linearization gives the change of the prediction with the parameters. A simulation at the end of
a fit gives its error there, which the next fit adds to the linearization (additive correction:
Alexandrov, Lewis, Optimization and Engineering 2, 2001). Two or three simulations replace one for
each parameter and step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.linearized_fit import fit_linearized, linearized_slopes
from pytest_twin.diagnosis.search.linearized_view import View
from pytest_twin.diagnosis.search.model import Model
from pytest_twin.estimation.comparison import Comparison
from pytest_twin.estimation.hypothesis import Hypothesis

_ITERATIONS = 3
"""Iterations of a fit in the linearized motion."""
_CONVERGED = 0.02
"""Decrease of the summed log mean square below which a fit has converged."""

Simulate = Callable[[Sequence[Hypothesis]], list[Model]]
"""Simulates hypotheses with the corrections of the incumbent, and adds them to the pool."""


def fit_along_motion(
    view: View, models: Sequence[Model], simulate: Simulate, floor: FloatArray, corrections: int
) -> list[Model]:
    """Models fitted in the linearized motion; a step is kept if its simulation is better.

    Args:
        view: the motion linearized around the incumbent.
        models: models with their start parameters, simulated.
        floor: (signals,) noise floor.
        corrections: largest number of fits and simulations of each model.
    """
    if view.linear is None:
        return list(models)
    best = list(models)
    active = [i for i, m in enumerate(best) if m.is_finite]
    for _ in range(corrections):
        if not active:
            break
        changes = view.linear.differences([best[i].hypothesis for i in active])
        targets = [
            view.bins.mean(best[i].residual) + change
            for i, change in zip(active, changes, strict=True)
        ]
        fitted = fit_linearized(
            view.linear, view.residual, [best[i].hypothesis for i in active], _ITERATIONS, targets
        )
        unconverged = []
        for i, model in zip(active, simulate([f.hypothesis for f in fitted]), strict=True):
            decrease = _misfit(best[i], floor) - _misfit(model, floor)
            if decrease > 0.0:
                best[i] = replace(model, origin=best[i].origin)
                if decrease > _CONVERGED:
                    unconverged.append(i)
        active = unconverged
    return best


def with_linearized_jacobians(
    view: View | None, models: Sequence[Model], comparison: Comparison
) -> list[Model]:
    """Models with the Jacobian of the linearized motion, which needs no simulation.

    Those that are fitted by simulation keep theirs.
    """
    if view is None or view.linear is None:
        return list(models)
    slopes = iter(linearized_slopes(view.linear, [m.hypothesis for m in models if not m.is_fitted]))
    return [
        m
        if m.is_fitted
        else m.with_jacobian(comparison, np.repeat(next(slopes), view.bins.counts, axis=0))
        for m in models
    ]


def _misfit(model: Model, floor: FloatArray) -> float:
    """Sum over signals of the log mean square, at least that of the noise floor."""
    return float(np.log(np.maximum(model.mean_square, floor**2)).sum())
