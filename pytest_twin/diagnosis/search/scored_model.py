"""Fitted hypotheses with the evidence for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.fit import Fitted
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.search.settings import SELECTION

Place = tuple[tuple[Term, ...], Term | None]
"""What is taken away, and what stands there instead; None for nothing."""


@dataclass(slots=True)
class ScoredModel:
    """A fitted hypothesis with its evidence.

    Attributes:
        fitted: on the fit segments.
        held_residual: (samples, signals) on the held-out segments.
        evidence: higher is better; comparable within one round.
    """

    fitted: Fitted
    held_residual: FloatArray
    evidence: float = 0.0
    held_gain: float = 0.0

    @property
    def hypothesis(self) -> Hypothesis:
        """With its fitted parameters."""
        return self.fitted.hypothesis

    @property
    def left(self) -> FloatArray:
        """(signals,) mean square on the fitted or on the validation recordings, the greater."""
        seen = self.fitted.mean_square
        if not len(self.held_residual):
            return seen
        most: FloatArray = np.maximum(np.mean(self.held_residual**2, axis=0), seen)
        return most


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another set of effects instead of some of those that were found.

    Attributes:
        new: effects that it has instead.
        gone: effects that it lacks.
        confidence: posterior share.
        apart: largest RMS difference between the two predictions, in noise floors; None if unknown.
    """

    new: tuple[Term, ...]
    gone: tuple[Term, ...]
    confidence: float
    apart: float | None = None


@dataclass(slots=True)
class SelectedModel:
    """What was chosen, and what stood against it.

    Attributes:
        best: the chosen rival.
        nominal: the nominal model.
        confidence: term -> share of the evidence against the rivals in its place.
        alternatives: term -> rivals in its place with their share, best first.
        evidence: term -> log-likelihood ratio over the best of the model with each alternative
            instead of the term; key None: without the term. It is exact where a share underflows.
        sets: term -> alternatives to it, sets of effects among them, most likely first; empty
            until the final set was compared with such sets. They then replace ``alternatives``.
        near: structures that explain nearly as much: their odds against the best, and how far the
            parameters of the terms that both have lie apart, scaled.
        tried: effects at joints that competed.
    """

    best: ScoredModel
    nominal: ScoredModel
    confidence: dict[Term, float] = field(default_factory=dict)
    alternatives: dict[Term, list[tuple[Term, float]]] = field(default_factory=dict)
    evidence: dict[Term, dict[Term | None, float]] = field(default_factory=dict)
    sets: dict[Term, list[Alternative]] = field(default_factory=dict)
    near: list[tuple[float, dict[Term, FloatArray]]] = field(default_factory=list)
    tried: int = 0

    def alternatives_to(self, term: Term) -> list[Alternative]:
        """What may explain the data instead of a term, most likely first."""
        if term in self.sets:
            return self.sets[term]
        return [Alternative((new,), (term,), c) for new, c in self.alternatives.get(term, [])]

    def weigh(self, evidence: Mapping[Place, float]) -> None:
        """Set how sure each term of the best is in its place, and what could stand there.

        Args:
            evidence: of others in the places of its terms, over the best.
        """
        self.confidence.clear()
        self.alternatives.clear()
        self.evidence.clear()
        for term in self.best.hypothesis.terms:
            # A law that has this one in it says the same where it says no more.
            others = {
                new: e for (gone, new), e in evidence.items()
                if gone == (term,) and not (new and term.effect in new.law.generalizes)
            }  # fmt: skip
            self.evidence[term] = others
            values = np.array([0.0, *others.values()])
            share = np.exp(np.clip(values - values.max(), -700.0, 0.0))
            share /= share.sum()
            self.confidence[term] = float(share[0])
            ranked = zip(others, map(float, share[1:]), strict=True)
            self.alternatives[term] = sorted(
                ((new, s) for new, s in ranked if new is not None), key=lambda each: -each[1]
            )


def simplest_good_model(earning: Sequence[ScoredModel]) -> ScoredModel:
    """The rival to go on from; ``earning`` by evidence, best first.

    Residuals are never white: one more effect or parameter always follows them a little better.
    A name that was needed after all is found in the next round.
    """
    first = earning[0].evidence
    fewest = min(
        len(r.hypothesis.terms) for r in earning if r.evidence >= SELECTION.fewer_as_good * first
    )
    alike = [r for r in earning if len(r.hypothesis.terms) == fewest]
    enough = min((1.0 - SELECTION.as_good) * alike[0].evidence, alike[0].evidence - SELECTION.earns)
    return min(
        (r for r in alike if r.evidence >= enough), key=lambda r: (r.hypothesis.free, -r.evidence)
    )


def compare_below_floor(rival: ScoredModel, other: ScoredModel, floor: FloatArray) -> int:
    """1 where a rival leaves clearly less than another, -1 where clearly more, else 0.

    The floor is the most that need not be explained. Where much less is left, it was estimated too
    high, and what is under it still tells two laws apart that explain as much.
    """

    def more(one: FloatArray, two: FloatArray) -> float:
        levels = (
            np.maximum(np.mean(r**2, axis=0), (SELECTION.least_told * floor) ** 2)
            for r in (one, two)
        )
        first, second = levels
        return float(0.5 * np.log(first / second).sum())

    each = [more(other.fitted.residual, rival.fitted.residual)]
    if len(rival.held_residual):
        each.append(more(other.held_residual, rival.held_residual))
    clearly = np.log(SELECTION.clearly_less)
    return int(min(each) >= clearly) - int(max(each) <= -clearly)


def describe_models(h: Hypothesis) -> str:
    """Terms, joints' columns and parameters, in multiples of their scales."""
    return " + ".join(f"{t.effect}@{t.joint}{np.round(h.theta[h.slice_of(t)], 3)}" for t in h.terms)
