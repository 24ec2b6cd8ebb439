"""Fits in the linearized motion, corrected by one simulation for each step.

The linearization gives the change of the prediction with the parameters. A simulation at the end of
a fit gives its error there, which the next fit adds to the linearization (additive correction:
Alexandrov, Lewis, Optimization and Engineering 2, 2001). Two or three simulations replace one for
each parameter and step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.linearized_fit import fit_linearized
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.linearized_view import LinearizedView
from pytest_twin.diagnosis.structure_search.score import Scorer, SimulatedModel
from pytest_twin.estimation.least_squares import FittedModel, fit

_ITERATIONS = 3
"""Iterations of a fit in the linearized motion."""


def fit_with_correction(
    scorer: Scorer, linearized: LinearizedView, models: Sequence[SimulatedModel], corrections: int
) -> list[SimulatedModel]:
    """Models fitted in the linearized motion; a step is kept if its simulation is better.

    Args:
        linearized: the linearization around the incumbent.
        models: models with their start parameters, simulated.
        corrections: largest number of fits and simulations of each model.
    """
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
        tried = scorer.simulate([p.hypothesis for p in fitted], models[0])
        unconverged = []
        for i, model in zip(active, tried, strict=True):
            before, after = (_misfit(scorer.problem, m) for m in (best[i], model))
            if after < before:
                best[i] = model
                if after < before - 0.02:
                    unconverged.append(i)
        active = unconverged
    return best


def fit_by_simulation(
    scorer: Scorer, model: SimulatedModel, iterations: int
) -> tuple[SimulatedModel, FloatArray]:
    """A model fitted by simulation, and its (samples, signals, parameters) Jacobian."""
    here = scorer.simulate_with_own_correction(model.hypothesis)
    problem = here.problem
    weights = problem.weights(np.mean(here.residual**2, axis=0))
    (found,) = fit(problem, [model.hypothesis], weights, problem.fit, iterations=iterations)
    return scorer.simulate([found.hypothesis], here)[0], found.jacobian


def to_fitted_model(problem: Problem, model: SimulatedModel, jacobian: FloatArray) -> FittedModel:
    """A model with its Jacobian as a :class:`FittedModel`, for intervals and reports."""
    weights = problem.weights(np.mean(model.residual**2, axis=0))
    return FittedModel(
        model.hypothesis, model.residual, jacobian, float(np.mean((model.residual * weights) ** 2))
    )


def _misfit(problem: Problem, model: SimulatedModel) -> float:
    """Sum over signals of the log mean square on the fit recordings, at least the noise floor."""
    mean_square = np.nan_to_num(np.mean(model.residual**2, axis=0), nan=np.inf)
    value = np.log(np.maximum(mean_square, problem.signal_floor**2)).sum()
    return float(value) if np.isfinite(value) else np.inf
