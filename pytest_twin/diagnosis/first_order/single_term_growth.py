"""Structures grown from single terms that are fitted along the motion with their laws exact.

To first order two wrong terms may look better than the right one whose law bends, and what acts
beside it is then looked for beside them: grown from what each single term comes to, the right one
gets its company.
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

# Single terms that are grown.
_ROOTS = 4


def grow_single_terms(
    view: ResidualView,
    answers: CandidateSensitivities,
    polished: Sequence[LinearizedFit],
    own: Hypothesis,
    search: Callable[[], BeamSearch],
    cores: int = 1,
) -> list[Hypothesis]:
    """The best structure of every size around each of the best single terms.

    Args:
        view: of the fit at hand.
        answers: of the candidates.
        polished: structures fitted along the motion, best first.
        own: the fit at hand.
        search: a fresh one.
        cores: that take part.
    """
    seen = {frozenset(p.hypothesis.terms) for p in polished}
    roots = [
        p for p in polished
        if p.hypothesis.more_terms(own) == 1
        and not p.hypothesis.at_bound(p.hypothesis.terms[-1])
    ]  # fmt: skip

    def grown(root: LinearizedFit) -> list[Hypothesis]:
        term = root.hypothesis.terms[-1]
        gives = np.concatenate([view.jacobian, _nearest(answers, root.hypothesis, term)], axis=2)
        others = CandidateSensitivities(
            [r for r in answers.responses if r.term not in root.hypothesis.terms]
        )
        lens = NormalEquations(ResidualView(root.residual, gives, view.floor, view.lengths), others)
        levels = search().levels(lens)
        return [root.hypothesis.with_terms(level[0].starts) for level in levels]

    out: list[Hypothesis] = []
    for h in chain(*Forks(cores).map(grown, roots[:_ROOTS])):
        if frozenset(h.terms) not in seen:
            seen.add(frozenset(h.terms))
            out.append(h)
    return out


def _nearest(answers: CandidateSensitivities, hypothesis: Hypothesis, term: Term) -> FloatArray:
    """(bins, signals, switches) response of a term where it is nearest to what it came to."""
    theta = hypothesis.theta[hypothesis.slice_of(term)]
    mine = [r for r in answers.responses if r.term == term]
    return min(mine, key=lambda r: float(np.sum((r.start - theta) ** 2))).change
