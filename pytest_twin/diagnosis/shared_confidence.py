"""Posterior confidence of effects from the comparison of the final set with other sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.equivalent_sets import ComparedSets
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.interval_settings import INTERVALS
from pytest_twin.diagnosis.search.scored_model import AlternativeEffects, SelectedModel

# Shares up to this value are rounding errors, so their logarithm is not used.
_ROUNDING = 1e-12


def share_confidence(selected: SelectedModel, compared: ComparedSets) -> SelectedModel:
    """The selection with the confidence of each effect against all other sets.

    The odds of a set are exp(evidence). The confidence of an effect is 1 / (1 + sum of the odds of
    sets that lack it). Doubt about an effect at one joint therefore does not reduce the confidence
    at another. Rivals of single effects from the search keep their odds, raised to the power by
    which model error tempers all evidence.

    Args:
        selected: result of the search.
        compared: the likeliest set and the other sets.
    """
    own = compared.best.hypothesis
    odds = {s.terms: float(np.exp(min(s.evidence, 700.0))) for s in compared.sets}
    other_sets = [
        _OtherSet(
            s.terms, _new_terms(s.model.hypothesis, own), odds[s.terms], s.prediction_difference
        )
        for s in compared.sets
        if not _only_generalizes(s.model.hypothesis, own)
    ]
    other_sets += _sets_of_search(selected, own, set(odds), compared.tempering)
    confidence: dict[Term, float] = {}
    sets: dict[Term, list[AlternativeEffects]] = {}
    for term in own.terms:
        alternatives = [s for s in other_sets if term not in s.terms]
        whole = 1.0 + sum(s.odds for s in alternatives)
        confidence[term] = 1.0 / whole
        sets[term] = sorted(
            (
                AlternativeEffects(
                    s.new,
                    tuple(t for t in own.terms if t not in s.terms),
                    s.odds / whole,
                    s.prediction_difference,
                )
                for s in alternatives
                if s.new
            ),
            key=lambda a: -a.confidence,
        )
    nearby = [
        (odds[s.terms], _offsets(s.model.hypothesis, own))
        for s in compared.sets
        if odds[s.terms] >= INTERVALS.least_odds
    ]
    return replace(
        selected,
        best=compared.best,
        confidence=confidence,
        alternatives={},
        sets=sets,
        nearby_models=nearby,
    )


class _OtherSet:
    """Another set of effects.

    Args:
        terms: all its terms.
        new: its terms that the final set lacks.
        odds: its posterior odds against the final set.
        prediction_difference: largest RMS difference of the predictions in noise floors; None if
            unknown.
    """

    def __init__(
        self,
        terms: frozenset[Term],
        new: tuple[Term, ...],
        odds: float,
        prediction_difference: float | None,
    ) -> None:
        self.terms, self.new, self.odds, self.prediction_difference = (
            terms,
            new,
            odds,
            prediction_difference,
        )


def _only_generalizes(other: Hypothesis, own: Hypothesis) -> bool:
    """Whether a set differs from another only by general laws instead of their special cases."""
    new = _new_terms(other, own)
    replaced = _new_terms(own, other)
    return len(new) == len(replaced) > 0 and all(
        any(special.effect in law.law.generalizes for special in replaced) for law in new
    )


def _new_terms(other: Hypothesis, own: Hypothesis) -> tuple[Term, ...]:
    """Terms of ``other`` that ``own`` lacks."""
    return tuple(t for t in other.terms if t not in own.terms)


def _offsets(other: Hypothesis, own: Hypothesis) -> dict[Term, FloatArray]:
    """Shared term -> difference of its parameters, in multiples of their scales."""
    return {
        t: other.theta[other.slice_of(t)] - own.theta[own.slice_of(t)]
        for t in own.terms
        if t in other.terms
    }


def _sets_of_search(
    selected: SelectedModel, own: Hypothesis, known: set[frozenset[Term]], tempering: float
) -> list[_OtherSet]:
    """Rival sets in which one effect is replaced or removed, from the confidence of the search.

    The share of the removal is one minus the confidence of the effect and of its alternatives.
    """
    out: list[_OtherSet] = []
    terms = frozenset(own.terms)
    if terms != frozenset(selected.best.hypothesis.terms):
        return out
    for term, confidence in selected.confidence.items():
        if term not in terms or not np.isfinite(confidence) or confidence <= 0.0:
            continue
        listed: Sequence[tuple[Term, float]] = selected.alternatives.get(term, [])
        removal = 1.0 - confidence - sum(c for _, c in listed)
        # Where no alternative was simulated, the shares are limited at both ends, and the evidence
        # of the linearized motion is not used.
        evidence = {} if term in selected.not_simulated else selected.evidence.get(term, {})
        for new, share in (*listed, (None, removal)):
            added = () if new is None else (new,)
            terms_of_set = (terms - {term}) | frozenset(added)
            ratio = evidence.get(new, -np.inf)
            if share > _ROUNDING:
                ratio = max(ratio, float(np.log(share / confidence)))
            if terms_of_set in known or not np.isfinite(ratio):
                continue
            odds = float(np.exp(min(tempering * ratio, 700.0)))
            out.append(_OtherSet(terms_of_set, added, odds, None))
    return out
