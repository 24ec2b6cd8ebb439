"""Structures that are grown from single terms, which are first fitted along the motion.

To first order, two wrong terms may explain more than one right term with a nonlinear law. The beam
search would then add further terms to the wrong ones. Here further terms are also added to each of
the best single terms at its fitted parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    BeamSearch,
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
)
from pytest_twin.diagnosis.first_order.linearized_fit import LinearizedFit
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.realization.executor import Forks

# Number of single terms to which others are added.
_ROOTS = 4


def grow_single_terms(
    view: ResidualView,
    candidate_sensitivities: CandidateSensitivities,
    linear_fits: Sequence[LinearizedFit],
    own: Hypothesis,
    search: Callable[[], BeamSearch],
    cores: int = 1,
) -> list[Hypothesis]:
    """The best structure of every size around each of the best single terms.

    Args:
        view: residual of the present hypothesis.
        candidate_sensitivities: sensitivities of the candidates.
        linear_fits: structures that were fitted along the motion, best first.
        own: the present hypothesis.
        search: makes a new beam search.
        cores: number of processes.
    """
    seen = {frozenset(p.hypothesis.terms) for p in linear_fits}
    roots = [
        p for p in linear_fits
        if p.hypothesis.more_terms(own) == 1
        and not p.hypothesis.at_bound(p.hypothesis.terms[-1])
    ]  # fmt: skip

    def grown(root: LinearizedFit) -> list[Hypothesis]:
        term = root.hypothesis.terms[-1]
        jacobian = np.concatenate(
            [view.jacobian, _nearest(candidate_sensitivities, root.hypothesis, term)], axis=2
        )
        others = CandidateSensitivities(
            [r for r in candidate_sensitivities.responses if r.term not in root.hypothesis.terms]
        )
        equations = NormalEquations(
            ResidualView(root.residual, jacobian, view.floor, view.lengths), others
        )
        levels = search().levels(equations)
        return [root.hypothesis.with_terms(level[0].starts) for level in levels]

    out: list[Hypothesis] = []
    for h in chain(*Forks(cores).map(grown, roots[:_ROOTS])):
        if frozenset(h.terms) not in seen:
            seen.add(frozenset(h.terms))
            out.append(h)
    return out


def _nearest(
    candidate_sensitivities: CandidateSensitivities, hypothesis: Hypothesis, term: Term
) -> FloatArray:
    """(bins, signals, switches) sensitivity at the grid size nearest to a term's parameters."""
    theta = hypothesis.theta[hypothesis.slice_of(term)]
    of_term = [r for r in candidate_sensitivities.responses if r.term == term]
    return min(of_term, key=lambda r: float(np.sum((r.start - theta) ** 2))).change
