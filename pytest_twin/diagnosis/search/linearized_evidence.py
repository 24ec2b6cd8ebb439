"""Evidence of models in the linearized motion, without any simulation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import ResidualView
from pytest_twin.diagnosis.first_order.linearized_fit import (
    FAR_ITERATIONS,
    LinearizedFit,
    fit_linearized,
)
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.estimation.hypothesis import Hypothesis


def linearized_evidence(
    view: ResidualView, linear_fits: Sequence[LinearizedFit], penalty_per_effect: float
) -> FloatArray:
    """Penalized log-likelihood of each fit in the linearized motion; comparable within a call."""
    effective = view.effective_of_best([p.residual for p in linear_fits])
    return np.array(
        [
            view.penalized_likelihood(p.residual, effective, p.hypothesis.free_count)
            - penalty_per_effect * len(p.hypothesis.terms)
            for p in linear_fits
        ]
    )


def fit_and_score_linearized(
    linear: Linearization,
    view: ResidualView,
    best: ScoredModel,
    others: Sequence[Hypothesis],
    penalty_per_effect: float,
) -> tuple[list[Hypothesis], FloatArray]:
    """Hypotheses fitted in the motion linearized at ``best``, and their evidence relative to it."""
    linear_fits = fit_linearized(linear, view, others, FAR_ITERATIONS)
    values = linearized_evidence(
        view, [LinearizedFit(best.hypothesis, view.residual), *linear_fits], penalty_per_effect
    )
    return [p.hypothesis for p in linear_fits], values[1:] - values[0]
