"""Confidence of effects from the pool of all models of a search.

A law of a richer set that contains effects of the incumbent is collapsed to them, and equal sets
are merged; a law that needs no more parameters is another cause. Each other set is an exchange:
effects that it lacks, and effects that it has instead. The odds of an exchange are the exponential
of its evidence. The confidence of an effect is one over one plus the odds of all exchanges that
remove it. An exchange that consists of two others counts with them: exchanges of independent causes
share nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.search.model import LEAST_ODDS, Model, PooledModel, evidence_of
from pytest_twin.diagnosis.search.search import SearchOutcome
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel

MOST_WITH_ONE_RECORDING = 0.9
"""Largest confidence from a single recording, whose parts are no independent repetitions, and of an
effect that acts in one recording only."""
MOST_UNFINISHED = 0.5
"""Largest confidence where a limit ended the search before it compared its result with all rivals,
or where more than noise remains, so that further effects may take the place of those so far."""
SAME_PREDICTION = 0.5
"""Noise floors up to which two predictions are equal, so that neither set can be preferred."""
_AS_LIKELY = 0.5
"""Evidence up to which two sets are equally likely."""

Terms = frozenset[Term]


@dataclass(frozen=True, slots=True)
class Exchange:
    """Another set of effects, as a change of the incumbent.

    Attributes:
        removed, added: effects that it lacks, and effects that it has instead.
        log_odds: logarithm of its odds against the incumbent.
        model: the set with its parameters.
    """

    removed: Terms
    added: Terms
    log_odds: float
    model: PooledModel


@dataclass(frozen=True, slots=True)
class AlternativeEffects:
    """Another set of effects instead of some of those that were found.

    Attributes:
        new: effects that it has instead.
        removed: effects that it lacks.
        prediction_difference: largest RMS difference between the two predictions, in noise floors;
            None if unknown.
    """

    new: tuple[Term, ...]
    removed: tuple[Term, ...]
    confidence: float
    prediction_difference: float | None = None


@dataclass(slots=True)
class Posterior:
    """Confidence of each effect of the incumbent.

    Attributes:
        confidence: term -> posterior probability, 0 to 1.
        alternatives: term -> other sets without it, most likely first.
        nearby: sets that explain nearly as much: their odds, and the offsets of shared parameters.
    """

    confidence: dict[Term, float] = field(default_factory=dict)
    alternatives: dict[Term, list[AlternativeEffects]] = field(default_factory=dict)
    nearby: list[tuple[float, dict[Term, FloatArray]]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class NamedModel:
    """The effects that carry a name, fitted.

    Attributes:
        reduced_models: the model refitted without each effect.
        notes: a line for each effect without a name.
        unresolved: effects of the model that carry no name -> the reason.
    """

    fitted: FittedModel
    reduced_models: Sequence[Hypothesis]
    posterior: Posterior
    notes: Sequence[str] = ()
    unresolved: dict[Term, str] = field(default_factory=dict)


def posterior(
    found: SearchOutcome, is_possible: Callable[[Hypothesis], bool] = lambda hypothesis: True
) -> Posterior:
    """Confidence and alternatives of each effect of the last incumbent.

    Args:
        is_possible: whether a set may be reported; others are no alternatives.
    """
    incumbent, out = found.incumbent, Posterior()
    rivals = (r for r in found.pool.rivals_of(incumbent) if is_possible(r.hypothesis))
    exchanges = independent(distinct(incumbent, rivals, _log_odds_of(found)))
    for term in incumbent.hypothesis.terms:
        against = [(e, float(np.exp(min(e.log_odds, 700.0)))) for e in exchanges
                   if term in e.removed]  # fmt: skip
        whole = 1.0 + sum(odds for _, odds in against)
        out.confidence[term] = min(1.0 / whole, _most(found, term))
        out.alternatives[term] = sorted(
            (
                AlternativeEffects(
                    tuple(sorted(e.added)), tuple(sorted(e.removed)), odds / whole,
                    e.model.difference,
                )
                for e, odds in against if e.added
            ),
            key=lambda a: -a.confidence,
        )  # fmt: skip
    out.nearby = [
        (float(np.exp(e.log_odds)), _offsets(e.model.hypothesis, incumbent.hypothesis))
        for e in exchanges
        if e.model.is_simulated and e.log_odds > np.log(LEAST_ODDS)
    ]
    return out


def _most(found: SearchOutcome, term: Term) -> float:
    """Largest confidence of an effect of the last incumbent."""
    incumbent = found.incumbent
    if not (found.is_complete or found.is_compared):
        return MOST_UNFINISHED
    is_alone = found.comparison.has_one_recording
    if incumbent.jacobian is not None:
        of_effect = incumbent.jacobian[:, :, incumbent.hypothesis.slice_of(term)]
        is_alone = found.comparison.rests_on_one_recording(incumbent.residual, of_effect)
    return MOST_WITH_ONE_RECORDING if is_alone else 1.0


def best_named(
    found: SearchOutcome,
    inexpressible: Callable[[Hypothesis], int],
    is_possible: Callable[[Hypothesis], bool],
) -> Hypothesis:
    """The incumbent, or a set that is as likely and simpler, or that MJCF expresses further.

    Args:
        inexpressible: number of effects of a set that MJCF cannot express.
        is_possible: whether a set may be reported.
    """
    incumbent = found.incumbent
    least = _evidence_of_incumbent(found) - _AS_LIKELY
    alike = [
        (rival.size, rival.hypothesis)
        for rival in found.pool.rivals_of(incumbent)
        if rival.is_simulated and not rival.size.is_richer_than(incumbent.size)
        and rival.evidence >= least and is_possible(rival.hypothesis)
    ]  # fmt: skip
    # The incumbent comes first among equals.
    named = min(
        [(incumbent.size, incumbent.hypothesis), *alike],
        key=lambda each: (each[0].effects, each[0].parameters, inexpressible(each[1])),
    )
    return named[1]


def _evidence_of_incumbent(found: SearchOutcome) -> float:
    incumbent = found.incumbent
    return evidence_of(found.comparison, incumbent.mean_square, incumbent.size)


def _log_odds_of(found: SearchOutcome) -> Callable[[PooledModel], float]:
    """Function that returns the log odds of a rival against the incumbent."""
    incumbent, of_incumbent = found.incumbent, _evidence_of_incumbent(found)

    def log_odds(rival: PooledModel) -> float:
        value = rival.evidence - of_incumbent
        is_richer = rival.size.is_richer_than(incumbent.size)
        is_cross_validated = rival.score is not None and rival.score <= incumbent.score
        if is_richer or is_cross_validated:
            # The search has decided that the richer set predicts no better. A set that fits better
            # and predicts recordings that are left out no better fits errors of the model.
            value = min(value, 0.0)
        alike = rival.difference is not None and rival.difference <= SAME_PREDICTION
        if alike and rival.size.effects <= incumbent.size.effects:
            return 0.0
        return value

    return log_odds


def distinct(
    incumbent: Model,
    rivals: Iterable[PooledModel],
    log_odds: Callable[[PooledModel], float],
) -> list[Exchange]:
    """Exchanges of the incumbent, each set of effects once with its largest odds."""
    own = frozenset(incumbent.hypothesis.terms)
    best = dict[tuple[Terms, Terms], Exchange]()
    for rival in rivals:
        terms = frozenset(rival.hypothesis.terms)
        if rival.size.is_richer_than(incumbent.size):
            terms = _collapsed(terms, own)
        key = own - terms, terms - own
        value = log_odds(rival)
        if (key[0] or key[1]) and (key not in best or value > best[key].log_odds):
            best[key] = Exchange(*key, value, rival)
    return list(best.values())


def independent(exchanges: Sequence[Exchange]) -> list[Exchange]:
    """Exchanges without those that consist of two others.

    An exchange that adds an unrelated effect to another one is the product of both. Its odds beyond
    that product are evidence of their own.
    """
    by_change = {(e.removed, e.added): e for e in exchanges}
    out = []
    for e in exchanges:
        products = [
            part.log_odds + rest.log_odds
            for (removed, added), part in by_change.items()
            if removed <= e.removed and added <= e.added and part is not e
            and (rest := by_change.get((e.removed - removed, e.added - added))) is not None
        ]  # fmt: skip
        product = max(products, default=-np.inf)
        if e.log_odds <= product + 1e-9:
            continue
        # What exceeds the product: log(exp(log_odds) - exp(product)).
        own = e.log_odds + float(np.log1p(-np.exp(product - e.log_odds)))
        out.append(replace(e, log_odds=own))
    return out


def _collapsed(terms: Terms, own: Terms) -> Terms:
    """A set with each law that generalizes effects of the incumbent replaced by these effects."""
    out = set[Term]()
    for term in terms:
        contained = {t for t in own if t.joint == term.joint and t.effect in term.law.generalizes}
        out |= contained if contained and term not in own else {term}
    return frozenset(out)


def _offsets(other: Hypothesis, own: Hypothesis) -> dict[Term, FloatArray]:
    """Shared term -> difference of its parameters, in multiples of their scales."""
    return {
        t: other.theta[other.slice_of(t)] - own.theta[own.slice_of(t)]
        for t in own.terms
        if t in other.terms
    }
