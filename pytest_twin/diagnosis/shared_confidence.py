"""Posterior confidence of effects from the comparison of the final set with other sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.equivalent_sets import ComparedSets
from pytest_twin.diagnosis.interval_settings import INTERVALS
from pytest_twin.diagnosis.search.scored_model import AlternativeEffects, SelectedModel
from pytest_twin.estimation.hypothesis import Hypothesis, Term

# Shares up to this value are rounding errors, so their logarithm is not used.
_ROUNDING = 1e-12


def share_confidence(selected: SelectedModel, compared: ComparedSets) -> SelectedModel:
    """The selection with the confidence of each effect against all other sets.

    The odds of a set are exp(evidence). The confidence of an effect is 1 / (1 + sum of the odds of
    sets that lack it). Doubt about an effect at one joint therefore does not reduce the confidence
    at another. Rivals of single effects from the search keep their odds, raised to the power by
    which model error tempers all evidence.

    Args:
        compared: the likeliest set and the other sets.
    """
    own = compared.best.hypothesis
    odds = {s.terms: float(np.exp(min(s.evidence, 700.0))) for s in compared.sets}
    other_sets = _distinct_sets(
        [_OtherSet(s.terms, odds[s.terms], s.prediction_difference) for s in compared.sets]
        + _sets_of_search(selected, own, set(odds), compared.tempering),
        own,
    )
    confidence: dict[Term, float] = {}
    sets: dict[Term, list[AlternativeEffects]] = {}
    for term in own.terms:
        alternatives = [s for s in other_sets if term not in s.terms]
        whole = 1.0 + sum(s.odds for s in alternatives)
        confidence[term] = 1.0 / whole
        sets[term] = sorted(
            (
                AlternativeEffects(
                    tuple(sorted(s.terms.difference(own.terms))),
                    tuple(t for t in own.terms if t not in s.terms),
                    s.odds / whole,
                    s.prediction_difference,
                )
                for s in alternatives
                if s.terms.difference(own.terms)
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


@dataclass(frozen=True)
class _OtherSet:
    """Another set of effects.

    Args:
        terms: all its terms.
        odds: its posterior odds against the final set.
        prediction_difference: largest RMS difference of the predictions in noise floors; None if
            unknown.
    """

    terms: frozenset[Term]
    odds: float
    prediction_difference: float | None


def _distinct_sets(sets: Sequence[_OtherSet], own: Hypothesis) -> list[_OtherSet]:
    """The sets that differ from the final one by more than general laws, each of them once.

    A general law contains its special case. A set with the general law is the set with the special
    case, counted a second time: beside it, every effect of another cause would lose confidence.
    """
    likeliest: dict[frozenset[Term], _OtherSet] = {}
    for other in sets:
        terms = _with_special_cases(other.terms, own)
        if terms == frozenset(own.terms):
            continue
        if terms not in likeliest or other.odds > likeliest[terms].odds:
            likeliest[terms] = replace(other, terms=terms)
    return list(likeliest.values())


def _with_special_cases(terms: frozenset[Term], own: Hypothesis) -> frozenset[Term]:
    """A set with each law that generalizes effects of the final set replaced by these effects."""
    special_cases: set[Term] = set()
    for term in terms - frozenset(own.terms):
        contained = {
            t for t in own.terms if t.joint == term.joint and t.effect in term.law.generalizes
        }
        special_cases |= contained - terms or {term}
    return (terms & frozenset(own.terms)) | special_cases


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
            out.append(_OtherSet(terms_of_set, odds, None))
    return out
