"""Odds of effects that the catalogue lists as confused and that no simulation compared.

A search that ends early has simulated fewer alternatives. Without their share, its names would be
surer than those of a complete search.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pytest_twin.diagnosis.finding_settings import FINDINGS
from pytest_twin.diagnosis.first_order.beam_search import NormalEquations, ResidualView
from pytest_twin.diagnosis.search.linearized_evidence import fit_and_score_linearized
from pytest_twin.diagnosis.search.linearized_view import LinearizedView
from pytest_twin.diagnosis.search.scored_model import (
    AlternativeEffects,
    ScoredModel,
    SelectedModel,
)
from pytest_twin.diagnosis.search.term_exchange import residuals_without
from pytest_twin.estimation.hypothesis import Hypothesis, Term

Odds = Mapping[Term, Mapping[Term, float]]
"""Term -> rival -> odds of the set with the rival instead of the term, against the final set."""


def odds_of_listed_rivals(
    best: ScoredModel, linearized: LinearizedView, penalty_per_effect: float
) -> dict[Term, dict[Term, float]]:
    """Odds of each listed rival, from its fit in the linearized motion.

    Where a rival predicts the same as the term, its odds are at least even: a simulation may find
    it exactly as good.

    Args:
        penalty_per_effect: penalty of the log-likelihood for each effect.
    """
    linear, view = linearized.linear, linearized.view
    sensitivities = linearized.candidate_sensitivities
    own = best.hypothesis
    out: dict[Term, dict[Term, float]] = {term: {} for term in own.terms}
    if linear is None:
        return out
    places = [(term,) for term in own.terms]
    left_without = residuals_without(best.problem, linear, view, own, places)
    for term, left in zip(own.terms, left_without, strict=True):
        slope = view.jacobian[:, :, own.parameters_without(term)]
        change = NormalEquations(
            ResidualView(left - view.residual, slope, view.floor, view.lengths), sensitivities
        )
        whole = NormalEquations(ResidualView(left, slope, view.floor, view.lengths), sensitivities)
        rest = own.without(term)
        closest: dict[Term, tuple[float, Hypothesis]] = {}
        for i, response in enumerate(sensitivities.responses):
            if not _is_listed_rival(term, response.term):
                continue
            unlike = change.structure((i,)).residual
            floors = float((np.sqrt(np.mean(unlike**2, axis=0)) / view.floor).max())
            if floors < closest.get(response.term, (np.inf, rest))[0]:
                closest[response.term] = floors, rest.with_terms(whole.structure((i,)).starts)
        if not closest:
            continue
        _, evidence = fit_and_score_linearized(
            linear, view, best, [start for _, start in closest.values()], penalty_per_effect
        )
        for (rival, (floors, _)), value in zip(closest.items(), evidence, strict=True):
            odds = float(np.exp(np.clip(np.nan_to_num(value, nan=-np.inf), -700.0, 700.0)))
            is_same = floors <= FINDINGS.same_prediction
            out[term][rival] = max(odds, 1.0) if is_same else odds
    return out


def with_listed_rivals(selected: SelectedModel, odds: Odds) -> SelectedModel:
    """The selection with the share of listed rivals that were not compared by simulation.

    Args:
        selected: the selection with its confidences.
        odds: result of :func:`odds_of_listed_rivals`.
    """
    confidence = dict(selected.confidence)
    alternatives, sets = dict(selected.alternatives), dict(selected.sets)
    for term, rivals in odds.items():
        compared = {new for other in selected.alternatives_to(term) for new in other.new}
        added = {rival: value for rival, value in rivals.items() if rival not in compared}
        before = confidence.get(term, 0.0)
        if not added or not np.isfinite(before) or before <= 0.0:
            continue
        after = 1.0 / (1.0 / before + sum(added.values()))
        confidence[term] = after
        scale = after / before
        if term in sets:
            known = [replace(other, confidence=scale * other.confidence) for other in sets[term]]
            known += [
                AlternativeEffects((rival,), (term,), after * value)
                for rival, value in added.items()
            ]
            sets[term] = sorted(known, key=lambda other: -other.confidence)
        else:
            shares = [(new, scale * share) for new, share in alternatives.get(term, [])]
            shares += [(rival, after * value) for rival, value in added.items()]
            alternatives[term] = sorted(shares, key=lambda each: -each[1])
    return replace(selected, confidence=confidence, alternatives=alternatives, sets=sets)


def _is_listed_rival(term: Term, other: Term) -> bool:
    """Whether the catalogue lists two effects as confused, at one joint or of the robot.

    The force of an elastic transmission along the measured motion contains what is to be explained:
    only a simulation compares it.
    """
    is_listed = other.effect in term.law.confused_with or term.effect in other.law.confused_with
    is_here = other.joint == term.joint or min(other.joint, term.joint) < 0
    is_general = term.effect in other.law.generalizes
    return is_listed and is_here and not is_general and not other.law.is_elastic_transmission
