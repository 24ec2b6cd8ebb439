"""Limits at sizes between those of the grid, where a joint is far off.

The change that one limit makes is no multiple of the change that another makes. The best size of
each limit is therefore fitted along the measured motion before structures are searched.
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
from pytest_twin.diagnosis.first_order.sensitivities import Linear, Sensitivity
from pytest_twin.diagnosis.hypothesis import Hypothesis

_FAR = 10.0
"""Floors beyond which a joint is far off."""
_ROUNDS = 3


def refine_limits(
    linear: Linear, view: ResidualView, answers: CandidateSensitivities, best: Hypothesis
) -> list[Sensitivity]:
    """Responses of limits, each at the size that fits best alone, at joints that are far off.

    Args:
        linear: around ``best``.
        view: its residual.
        answers: responses on the grid.
        best: the hypothesis at hand.
    """
    joints = len(linear.problem.joints)
    far = np.sqrt(view.mean_square)[:joints] > _FAR * view.floor[:joints]
    if not far.any():
        return []
    lens = NormalEquations(view, answers)
    starts: list[Hypothesis] = []
    for chosen in lens.children(lens.bare, len(answers.responses)):
        response = answers.responses[chosen[0]]
        if _is_lone_limit(response) and far[max(response.term.joint, 0)]:
            ((term, start),) = lens.structure(chosen).starts.items()
            starts.append(best.with_term(term, start))
    alone = [
        best.with_term(h.terms[-1], h.theta[h.slice_of(h.terms[-1])])
        for h in (p.hypothesis for p in fit_linearized(linear, view, starts, _ROUNDS))
    ]
    return _responses(linear, alone)


def _is_lone_limit(response: Sensitivity) -> bool:
    """Whether the law is a limit that one parameter switches on."""
    return response.term.law.is_limit and len(response.switches) == 1


def _responses(linear: Linear, hypotheses: Sequence[Hypothesis]) -> list[Sensitivity]:
    out = []
    for h, change in zip(hypotheses, linear.differences(hypotheses) if hypotheses else [],
                         strict=True):  # fmt: skip
        term = h.terms[-1]
        start = h.theta[h.slice_of(term)].copy()
        switch = term.switches(start)[0]
        if start[switch] and np.isfinite(change).all() and change.any():
            out.append(Sensitivity(term, start, (switch,), change[..., None].astype(np.float32)))
    return out
