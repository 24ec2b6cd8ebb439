"""Shortlist of sets of effects, from the linearized motion without any simulation.

A beam search over first-order sensitivities proposes sets (:mod:`beam_search`). The best ones are
fitted in the linearized motion with their exact laws (:mod:`linearized_fit`). The search is
repeated around the best fitted single effects (:mod:`single_term_growth`).
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
    """The best sets of effects in the linearized motion.

    Attributes:
        starts: sets to be simulated, best first.
        left: (signals,) mean squared residual of the best one.
        singles: all fitted sets that add one effect to the present fit.
    """

    starts: list[Hypothesis]
    left: FloatArray
    singles: list[Hypothesis]


def linearized_shortlist(
    comparison: ModelComparison, best: ScoredModel, linearized: LinearizedView
) -> LinearizedShortlist | None:
    """The best sets of effects in the linearized motion; None without candidates.

    Args:
        comparison: the comparison of the search.
        best: the present fit.
        linearized: the linearization around it.
    """
    if not linearized.candidate_sensitivities.responses:
        return None
    whole = _mismatch_to_explain(comparison, best)
    cores = comparison.problem.simulator.threads

    def search(width: int = SHORTLIST.width, most: int = SHORTLIST.added) -> BeamSearch:
        return BeamSearch(
            width,
            most,
            SELECTION.earns,
            lambda before, after: comparison.reduces_error_enough(before, after, whole),
            cores,
        )

    levels = search().levels(NormalEquations(linearized.view, linearized.candidate_sensitivities))
    if not levels:
        # No set gains to first order; distant starts and limits may still gain by simulation.
        return LinearizedShortlist([], linearized.view.mean_square, [])
    # Shape parameters are only known on a grid, so more of the single effects are fitted.
    chosen = [
        structure
        for level in reversed(levels)
        for structure in level[
            : SHORTLIST.fitted if level is not levels[0] else SHORTLIST.fitted_alone
        ]
    ]
    starts = [best.hypothesis.with_terms(structure.starts) for structure in chosen]
    if linearized.linear is None:
        singles = [h for h in starts if h.more_terms(best.hypothesis) == 1]
        return LinearizedShortlist(starts, np.mean(chosen[0].residual ** 2, axis=0), singles)
    linear_fits = fit_linearized(linearized.linear, linearized.view, starts, NEARBY)
    linear_fits = _by_evidence(linearized.view, linear_fits, comparison.penalty_per_effect)
    left = np.mean(linear_fits[0].residual ** 2, axis=0)
    if linearized.view.above(left, VERDICT.stands_out).any():
        more = grow_single_terms(
            linearized.view, linearized.candidate_sensitivities, linear_fits, best.hypothesis,
            lambda: search(SHORTLIST.width_around_single, SHORTLIST.added - 1), cores,
        )  # fmt: skip
        linear_fits += fit_linearized(linearized.linear, linearized.view, more, NEARBY)
    return _select(linearized.view, linear_fits, best, comparison.penalty_per_effect)


def _mismatch_to_explain(comparison: ModelComparison, best: ScoredModel) -> FloatArray:
    """(signals,) mean squared error of the nominal model that effects have to explain.

    It is that of the fit recordings, without the part that the found laws may leave because they
    are inexact. It is reduced by the ratio of the remaining shares of fit and validation error: an
    effect that the validation recordings still need has to explain less.
    """
    floor = comparison.problem.signal_floor**2
    whole = comparison.nominal.fitted.mean_square
    kept = (best.fitted.mean_square + floor) / (whole + floor)
    unseen = (comparison.validation_mean_square(best) + floor) / (
        comparison.validation_mean_square(comparison.nominal) + floor
    )
    whole = comparison.mismatch(best, whole, best.fitted.mean_square)
    less: FloatArray = whole * np.minimum(kept / unseen, 1.0)
    return less


def _by_evidence(
    view: ResidualView, linear_fits: Sequence[LinearizedFit], penalty_per_effect: float
) -> list[LinearizedFit]:
    """Fits in the order of their evidence, best first."""
    order = np.argsort(
        -np.nan_to_num(linearized_evidence(view, linear_fits, penalty_per_effect), nan=-np.inf)
    )
    return [linear_fits[i] for i in order]


def _select(
    view: ResidualView,
    linear_fits: Sequence[LinearizedFit],
    best: ScoredModel,
    penalty_per_effect: float,
) -> LinearizedShortlist:
    """The shortlist of fits, without variants of better ones."""
    evidence = linearized_evidence(view, linear_fits, penalty_per_effect)
    order = np.argsort(-evidence)
    front: list[int] = []
    for i in order:
        terms = set(linear_fits[i].hypothesis.terms)
        # A superset of a better set is left out unless its additional effects gain enough.
        covered = any(
            terms > set(linear_fits[k].hypothesis.terms)
            and evidence[i] < evidence[k] + SELECTION.earns
            for k in order
        )
        # So is a set that differs from a better one in a single effect.
        new = terms - set(best.hypothesis.terms)
        alike = any(_differs_in_one_term(new, set(linear_fits[k].hypothesis.terms)) for k in front)
        if np.isfinite(evidence[i]) and not covered and not alike:
            front.append(int(i))
    # Strong effects are not linear, so the best two single effects are simulated in any case.
    hypotheses = [p.hypothesis for p in linear_fits]
    singles = [h for h in hypotheses if h.more_terms(best.hypothesis) == 1]
    alone = [i for i in front if hypotheses[i].more_terms(best.hypothesis) == 1]
    front = [
        *front[: COMPARISON.finalists],
        *(i for i in alone[:2] if i not in front[: COMPARISON.finalists]),
    ]
    left: FloatArray = np.mean(linear_fits[front[0]].residual ** 2, axis=0)
    return LinearizedShortlist([hypotheses[i] for i in front], left, singles)


def _differs_in_one_term(new: set[Term], other: set[Term]) -> bool:
    """Whether another set has all but one of several ``new`` terms."""
    return len(new & other) > 1 and len(new - other) == 1


def linearized_evidence(
    view: ResidualView, linear_fits: Sequence[LinearizedFit], penalty_per_effect: float
) -> FloatArray:
    """Penalized log-likelihood of each fit in the linearized motion; comparable within a call."""
    effective = view.effective_of_best([p.residual for p in linear_fits])
    return np.array(
        [
            view.worth(p.residual, effective, p.hypothesis.free)
            - penalty_per_effect * len(p.hypothesis.terms)
            for p in linear_fits
        ]
    )


def fit_and_score_linearized(
    linear: Linear,
    view: ResidualView,
    best: ScoredModel,
    others: Sequence[Hypothesis],
    penalty_per_effect: float,
) -> tuple[list[Hypothesis], FloatArray]:
    """Hypotheses fitted in the motion linearized at ``best``, and their evidence relative to it."""
    linear_fits = fit_linearized(linear, view, others, FAR_OFF)
    values = linearized_evidence(
        view, [LinearizedFit(best.hypothesis, view.residual), *linear_fits], penalty_per_effect
    )
    return [p.hypothesis for p in linear_fits], values[1:] - values[0]
