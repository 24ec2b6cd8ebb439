"""What is best along the measured motion, nothing of it simulated.

Structures of several candidates are searched to first order (:mod:`beam_search`). The best are
fitted along the motion with their laws exact (:mod:`linearized_fit`). The search is repeated from
the best single terms as they were fitted (:mod:`single_term_growth`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import BeamSearch, NormalEquations, ResidualView
from pytest_twin.diagnosis.first_order.linearized_fit import (
    FAR_OFF,
    NEARBY,
    LinearizedFit,
    fit_linearized,
)
from pytest_twin.diagnosis.first_order.sensitivities import Linear
from pytest_twin.diagnosis.first_order.single_term_growth import grow_single_terms
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.search.linearized_view import LinearizedView
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.settings import COMPARISON, SELECTION, SHORTLIST
from pytest_twin.diagnosis.verdict_settings import VERDICT


@dataclass(slots=True)
class LinearizedShortlist:
    """What is best along the motion.

    Attributes:
        starts: the few structures that are worth a simulation, best first.
        left: (signals,) mean square that the best leaves.
        singles: all those that add least.
    """

    starts: list[Hypothesis]
    left: FloatArray
    singles: list[Hypothesis]


def linearized_shortlist(
    comparison: ModelComparison, best: ScoredModel, look: LinearizedView
) -> LinearizedShortlist | None:
    """The best structures along the motion, None without candidates.

    Args:
        comparison: of the search.
        best: the fit at hand.
        look: at it.
    """
    if not look.answers.responses:
        return None
    whole = _whole(comparison, best)
    cores = comparison.problem.simulator.threads

    def search(width: int = SHORTLIST.width, most: int = SHORTLIST.added) -> BeamSearch:
        return BeamSearch(
            width,
            most,
            SELECTION.earns,
            lambda before, after: comparison.worth_a_name(before, after, whole),
            cores,
        )

    levels = search().levels(NormalEquations(look.view, look.answers))
    if not levels:
        # No slope leads anywhere: what is simulated may all the same.
        return LinearizedShortlist([], look.view.mean_square, [])
    # Shapes of single terms are known as well as their grids are: more of them get a chance.
    chosen = [
        structure
        for level in reversed(levels)
        for structure in level[
            : SHORTLIST.fitted if level is not levels[0] else SHORTLIST.fitted_alone
        ]
    ]
    starts = [best.hypothesis.with_terms(structure.starts) for structure in chosen]
    if look.linear is None:
        singles = [h for h in starts if h.more_terms(best.hypothesis) == 1]
        return LinearizedShortlist(starts, np.mean(chosen[0].residual ** 2, axis=0), singles)
    polished = fit_linearized(look.linear, look.view, starts, NEARBY)
    polished = _by_evidence(look.view, polished, comparison.name_price)
    left = np.mean(polished[0].residual ** 2, axis=0)
    if look.view.above(left, VERDICT.stands_out).any():
        more = grow_single_terms(
            look.view, look.answers, polished, best.hypothesis,
            lambda: search(SHORTLIST.width_around_single, SHORTLIST.added - 1), cores,
        )  # fmt: skip
        polished += fit_linearized(look.linear, look.view, more, NEARBY)
    return _foremost(look.view, polished, best, comparison.name_price)


def _whole(comparison: ModelComparison, best: ScoredModel) -> FloatArray:
    """(signals,) mean square that the nominal model left of what is fitted; less where what no
    fit has seen keeps a greater share of its own: there a name counts for more.
    """
    floor = comparison.problem.signal_floor**2
    whole = comparison.nominal.fitted.mean_square
    kept = (best.fitted.mean_square + floor) / (whole + floor)
    unseen = (comparison.unseen(best) + floor) / (comparison.unseen(comparison.nominal) + floor)
    whole = comparison.mismatch(best, whole, best.fitted.mean_square)
    less: FloatArray = whole * np.minimum(kept / unseen, 1.0)
    return less


def _by_evidence(
    view: ResidualView, polished: Sequence[LinearizedFit], name_price: float
) -> list[LinearizedFit]:
    order = np.argsort(-np.nan_to_num(linearized_evidence(view, polished, name_price), nan=-np.inf))
    return [polished[i] for i in order]


def _foremost(
    view: ResidualView, polished: Sequence[LinearizedFit], best: ScoredModel, name_price: float
) -> LinearizedShortlist:
    evidence = linearized_evidence(view, polished, name_price)
    order = np.argsort(-evidence)
    front: list[int] = []
    for i in order:
        terms = set(polished[i].hypothesis.terms)
        # What only adds to another in front, and not enough, says nothing new.
        covered = any(
            terms > set(polished[k].hypothesis.terms)
            and evidence[i] < evidence[k] + SELECTION.earns
            for k in order
        )
        # Nor does another with one term instead of one.
        new = terms - set(best.hypothesis.terms)
        alike = any(_alike(new, set(polished[k].hypothesis.terms)) for k in front)
        if np.isfinite(evidence[i]) and not covered and not alike:
            front.append(int(i))
    # What acts strongly is only roughly of first order: the best single terms are simulated.
    hypotheses = [p.hypothesis for p in polished]
    singles = [h for h in hypotheses if h.more_terms(best.hypothesis) == 1]
    alone = [i for i in front if hypotheses[i].more_terms(best.hypothesis) == 1]
    front = [
        *front[: COMPARISON.finalists],
        *(i for i in alone[:2] if i not in front[: COMPARISON.finalists]),
    ]
    left: FloatArray = np.mean(polished[front[0]].residual ** 2, axis=0)
    return LinearizedShortlist([hypotheses[i] for i in front], left, singles)


def _alike(new: set[Term], other: set[Term]) -> bool:
    """Whether one of several new terms is all that another structure lacks."""
    return len(new & other) > 1 and len(new - other) == 1


def linearized_evidence(
    view: ResidualView, polished: Sequence[LinearizedFit], name_price: float
) -> FloatArray:
    """Log-likelihood less price of hypotheses along the measured motion, comparable."""
    effective = view.effective_of_best([p.residual for p in polished])
    return np.array(
        [
            view.worth(p.residual, effective, p.hypothesis.free)
            - name_price * len(p.hypothesis.terms)
            for p in polished
        ]
    )


def fit_and_score_linearized(
    linear: Linear,
    view: ResidualView,
    best: ScoredModel,
    others: Sequence[Hypothesis],
    name_price: float,
) -> tuple[list[Hypothesis], FloatArray]:
    """Hypotheses fitted along the measured motion of ``best``, and their evidence over it."""
    polished = fit_linearized(linear, view, others, FAR_OFF)
    values = linearized_evidence(
        view, [LinearizedFit(best.hypothesis, view.residual), *polished], name_price
    )
    return [p.hypothesis for p in polished], values[1:] - values[0]
