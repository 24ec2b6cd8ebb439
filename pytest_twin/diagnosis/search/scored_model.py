"""Fitted hypotheses with the evidence for each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.settings import SELECTION
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel

Place = tuple[tuple[Term, ...], Term | None]
"""Terms that are removed, and the term that replaces them; None for no term."""


@dataclass(slots=True)
class ScoredModel:
    """A fitted hypothesis with its evidence.

    Attributes:
        fitted: the fit to the fit recordings.
        held_residual: (samples, signals) residual on the validation recordings.
        problem: the problem with the corrections of its predictions.
        evidence: penalized log-likelihood relative to a reference; comparable within one round.
        held_gain: log-likelihood on the validation recordings relative to the same reference.
    """

    fitted: FittedModel
    held_residual: FloatArray
    problem: Problem
    evidence: float = 0.0
    held_gain: float = 0.0

    @property
    def hypothesis(self) -> Hypothesis:
        """The hypothesis with its fitted parameters."""
        return self.fitted.hypothesis

    @property
    def max_mean_square(self) -> FloatArray:
        """(signals,) mean squared residual, the larger of fit and validation recordings."""
        seen = self.fitted.mean_square
        if not len(self.held_residual):
            return seen
        most: FloatArray = np.maximum(np.mean(self.held_residual**2, axis=0), seen)
        return most


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
class SelectedModel:
    """The selected model and its alternatives.

    Attributes:
        confidence: term -> posterior share against its alternatives, 0 to 1.
        alternatives: term -> effects that could replace it with their shares, best first.
        evidence: term -> evidence of the model with each alternative instead of the term, relative
            to the best; key None: without the term. It is exact where a share underflows.
        sets: term -> alternative sets of effects, most likely first; empty until the final set was
            compared with other sets. They then replace ``alternatives``.
        nearby_models: models that explain nearly as much: their odds against the best, and the
            difference of the parameters of common terms, scaled.
        candidate_count: number of candidates.
        not_simulated: terms whose alternatives were not simulated, because the time was over: they
            were compared in the linearized motion, or not at all.
        nearly_as_good: other sets, fitted, that the structure search found nearly as good as its
            result.
    """

    best: ScoredModel
    nominal: ScoredModel
    confidence: dict[Term, float] = field(default_factory=dict)
    alternatives: dict[Term, list[tuple[Term, float]]] = field(default_factory=dict)
    evidence: dict[Term, dict[Term | None, float]] = field(default_factory=dict)
    sets: dict[Term, list[AlternativeEffects]] = field(default_factory=dict)
    nearby_models: list[tuple[float, dict[Term, FloatArray]]] = field(default_factory=list)
    candidate_count: int = 0
    not_simulated: frozenset[Term] = frozenset()
    nearly_as_good: tuple[Hypothesis, ...] = ()

    def alternatives_to(self, term: Term) -> list[AlternativeEffects]:
        """Alternatives to a term, most likely first."""
        if term in self.sets:
            return self.sets[term]
        return [
            AlternativeEffects((new,), (term,), c) for new, c in self.alternatives.get(term, [])
        ]

    def weigh(self, evidence: Mapping[Place, float]) -> None:
        """Set confidence and alternatives of each term from the evidence of its alternatives.

        Args:
            evidence: (removed terms, new term) -> evidence relative to the best model.
        """
        self.confidence.clear()
        self.alternatives.clear()
        self.evidence.clear()
        self.not_simulated = frozenset()
        for term in self.best.hypothesis.terms:
            # A more general law that gains nothing is no alternative to its special case.
            others = {
                new: e for (removed, new), e in evidence.items()
                if removed == (term,) and not (new and term.effect in new.law.generalizes)
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


def compare_below_floor(model: ScoredModel, other: ScoredModel, floor: FloatArray) -> int:
    """Compare residuals that are both below the noise floor.

    The noise floor is an upper estimate. If both residuals are far below it, their ratio still
    separates two laws.

    Returns:
        1 if the residual of ``model`` is clearly smaller, -1 if it is clearly larger, else 0.
    """

    def more(one: FloatArray, two: FloatArray) -> float:
        levels = (
            np.maximum(np.mean(r**2, axis=0), (SELECTION.least_told * floor) ** 2)
            for r in (one, two)
        )
        first, second = levels
        return float(0.5 * np.log(first / second).sum())

    each = [more(other.fitted.residual, model.fitted.residual)]
    if len(model.held_residual):
        each.append(more(other.held_residual, model.held_residual))
    clearly = np.log(SELECTION.clearly_less)
    return int(min(each) >= clearly) - int(max(each) <= -clearly)
