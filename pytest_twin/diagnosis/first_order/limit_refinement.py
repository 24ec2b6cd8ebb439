"""Limits at sizes between those of the grid, at joints with a large residual.

The response to a limit is not proportional to its size. The best size of each limit is therefore
fitted along the measured motion before structures are searched.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
)
from pytest_twin.diagnosis.first_order.linearized_fit import fit_linearized
from pytest_twin.diagnosis.first_order.sensitivities import Linearization, Sensitivity
from pytest_twin.diagnosis.first_order.settings import FIRST_ORDER
from pytest_twin.estimation.hypothesis import Hypothesis

# Iterations of each fit.
_ROUNDS = 3


def refine_limits(
    linear: Linearization,
    view: ResidualView,
    candidate_sensitivities: CandidateSensitivities,
    best: Hypothesis,
) -> list[Sensitivity]:
    """Sensitivities to limits at the size that fits best alone, at joints with a large residual.

    Args:
        linear: linearization around ``best``.
        candidate_sensitivities: sensitivities on the grid of starting sizes.
    """
    joints = len(linear.problem.joints)
    far = np.sqrt(view.mean_square)[:joints] > FIRST_ORDER.limits_from * view.floor[:joints]
    if not far.any():
        return []
    equations = NormalEquations(view, candidate_sensitivities)
    starts: list[Hypothesis] = []
    for chosen in equations.children(equations.base):
        response = candidate_sensitivities.responses[chosen[0]]
        if is_single_amplitude_limit(response) and far[max(response.term.joint, 0)]:
            ((term, start),) = equations.structure(chosen).starts.items()
            starts.append(best.with_term(term, start))
    alone = [
        best.with_term(h.terms[-1], h.theta[h.slice_of(h.terms[-1])])
        for h in (p.hypothesis for p in fit_linearized(linear, view, starts, _ROUNDS))
    ]
    return _limit_sensitivities(linear, alone)


def is_single_amplitude_limit(response: Sensitivity) -> bool:
    """Whether the law is a limit that one parameter switches on."""
    return response.term.law.is_limit and len(response.amplitude_indices) == 1


def _limit_sensitivities(
    linear: Linearization, hypotheses: Sequence[Hypothesis]
) -> list[Sensitivity]:
    out = []
    for h, change in zip(hypotheses, linear.differences(hypotheses) if hypotheses else [],
                         strict=True):  # fmt: skip
        term = h.terms[-1]
        start = h.theta[h.slice_of(term)].copy()
        amplitude = term.amplitude_indices(start)[0]
        if start[amplitude] and np.isfinite(change).all() and change.any():
            out.append(Sensitivity(term, start, (amplitude,), change[..., None].astype(np.float32)))
    return out
