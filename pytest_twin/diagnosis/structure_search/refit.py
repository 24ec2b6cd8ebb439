"""Fits that cost one simulation each: the linearized motion corrected by what simulation shows.

The linearization predicts how the prediction changes with the parameters; one simulation shows by
how much it is wrong where the fit ended, and the next fit starts from there with that error taken
out (model management by additive correction: Alexandrov, Lewis, Optimization and Engineering 2,
2001). Two or three simulations take the place of one for each parameter and step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.linearized_fit import fit_linearized
from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.linearized_view import LinearizedView
from pytest_twin.diagnosis.structure_search.score import Model, Scorer

_ITERATIONS = 3
"""Of a fit along the motion."""


def corrected_fits(
    scorer: Scorer, linearized: LinearizedView, models: Sequence[Model], corrections: int
) -> list[Model]:
    """Models fitted by the linearized motion, each step confirmed by a simulation."""
    if linearized.linear is None:
        return list(models)
    best = list(models)
    active = [i for i, m in enumerate(best) if np.isfinite(m.mean_square).all()]
    for _ in range(corrections):
        if not active:
            break
        changes = linearized.linear.differences([best[i].hypothesis for i in active])
        targets = [
            linearized.linear.bins.mean(best[i].residual) + d
            for i, d in zip(active, changes, strict=True)
        ]
        fitted = fit_linearized(
            linearized.linear,
            linearized.view,
            [best[i].hypothesis for i in active],
            _ITERATIONS,
            targets,
        )
        tried = scorer.simulate([p.hypothesis for p in fitted])
        still = []
        for i, model in zip(active, tried, strict=True):
            before, after = (_misfit(scorer.problem, m) for m in (best[i], model))
            if after < before:
                best[i] = model
                if after < before - 0.02:
                    still.append(i)
        active = still
    return best


def settled(scorer: Scorer, model: Model, iterations: int) -> tuple[Model, FloatArray]:
    """A model fitted by simulated gradients, and the (samples, signals, parameters) gradients."""
    problem = scorer.problem
    problem.refine_at(model.hypothesis)
    (here,) = scorer.simulate([model.hypothesis])
    weights = problem.weights(np.mean(here.residual**2, axis=0))
    (found,) = fit(problem, [model.hypothesis], weights, problem.fit, iterations=iterations)
    return scorer.simulate([found.hypothesis])[0], found.jacobian


def as_fitted(problem: Problem, model: Model, jacobian: FloatArray) -> Fitted:
    """A model in the form that intervals and reports take."""
    weights = problem.weights(np.mean(model.residual**2, axis=0))
    return Fitted(
        model.hypothesis, model.residual, jacobian, float(np.mean((model.residual * weights) ** 2))
    )


def _misfit(problem: Problem, model: Model) -> float:
    """Sum of log mean squares of the fit recordings, not below the noise floor."""
    mean_square = np.nan_to_num(np.mean(model.residual**2, axis=0), nan=np.inf)
    value = np.log(np.maximum(mean_square, problem.signal_floor**2)).sum()
    return float(value) if np.isfinite(value) else np.inf
