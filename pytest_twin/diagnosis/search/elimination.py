"""Backward elimination: effects and parameters that do not pay their penalty are removed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.diagnosis.first_order.sensitivities import Linearization, linearize
from pytest_twin.diagnosis.search.linearized_evidence import fit_and_score_linearized
from pytest_twin.diagnosis.search.linearized_view import residual_view
from pytest_twin.diagnosis.search.model_comparison import (
    DECIDING_ITERATIONS,
    RANKING_ITERATIONS,
    ModelComparison,
)
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.settings import EXCHANGE, SELECTION
from pytest_twin.diagnosis.search.simplification import (
    equal_sized_forms,
    merge_joints,
    merge_terms,
    simpler_forms,
    special_cases,
    split_terms,
)
from pytest_twin.estimation.hypothesis import Hypothesis, Term


@dataclass(frozen=True, slots=True)
class EliminationResult:
    """Result of a backward elimination.

    Attributes:
        simplification_evidence: terms of a simplification that was simulated -> its evidence
            relative to ``best``.
    """

    best: ScoredModel
    simplification_evidence: Mapping[tuple[Term, ...], float]


def eliminate(comparison: ModelComparison, best: ScoredModel) -> EliminationResult:
    """The best fit after backward elimination.

    Effects that do not pay their penalty are removed. Laws are merged, or replaced by special cases
    and simpler forms that explain as much. A simplification that clearly loses in the linearized
    motion is not simulated, except that of an elastic transmission.
    """
    simplification_evidence = dict[tuple[Term, ...], float]()
    while best.hypothesis.terms:
        simplification_evidence, problem = {}, best.problem
        terms = best.hypothesis.terms
        simplifications = [best.hypothesis.without(t) for t in terms] if len(terms) > 1 else []
        linear = linearize(problem, problem.fit, best.hypothesis)
        simplifications += merge_terms(problem, best.hypothesis)
        simplifications += simpler_forms(problem, best.hypothesis)
        if linear is not None:
            simplifications += equal_sized_forms(best.hypothesis)
        tolerance = evidence_tolerance(comparison, best, linear)
        doubtful = plausible_simplifications(comparison, best, linear, simplifications, tolerance)
        doubtful += special_cases(problem, best.hypothesis)
        doubtful += split_terms(problem, best.hypothesis)
        # A shift in time changes the discretization error, so each has its own.
        models = [
            comparison.fit_with_own_correction(h, best)
            for h in merge_joints(problem, best.hypothesis)
        ]
        if not doubtful and not models:
            break
        # In contact each simplification is fitted by simulation, so the fits are shorter.
        iterations = RANKING_ITERATIONS if linear is None else DECIDING_ITERATIONS
        comparison.score_models(models, best)
        models += comparison.score_against(doubtful, best, iterations)
        simplification_evidence = {r.hypothesis.terms: r.evidence for r in models}
        top = max(models, key=lambda r: r.evidence + tolerance(r.hypothesis))
        if top.evidence + tolerance(top.hypothesis) < -SELECTION.earns / 2:
            why = f"without what it leaves out the score falls by {-top.evidence:.1f}"
            comparison.record_step("elimination", "rejected", why, top, best)
            break
        comparison.record_step(
            "elimination", "accepted",
            f"fewer effects or parameters cost only {max(-top.evidence, 0.0):.1f}", top, best,
        )  # fmt: skip
        best = comparison.fit_to_convergence(top)
    return EliminationResult(best, simplification_evidence)


def evidence_tolerance(
    comparison: ModelComparison, best: ScoredModel, linear: Linearization | None
) -> Callable[[Hypothesis], float]:
    """How far the evidence of a simplification may be below that of ``best``.

    A law in a more general form follows the errors of the simulator a little, in proportion to what
    the law does. A form with fewer parameters may therefore be behind by that much. A form with as
    many parameters must be ahead, and so must the parts of a law that is at its bound.
    """
    own, lost_of = best.hypothesis, dict[Term, float]()
    several = [t for t in own.terms if t.law.has_forms]
    if linear is not None and several:
        view = residual_view(best, linear.residual(best.fitted.residual))
        removed = [own.without(t) for t in several]
        _, evidence = fit_and_score_linearized(
            linear, view, best, removed, comparison.penalty_per_effect
        )
        lost = np.maximum(-np.nan_to_num(evidence), 0.0) * comparison.sample_ratio
        lost_of = dict(zip(several, lost.tolist(), strict=True))

    def tolerance(other: Hypothesis) -> float:
        if other.terms == own.terms and other.free_count == own.free_count:
            return -SELECTION.other_form
        if len(other.terms) > len(own.terms):
            return comparison.penalty_per_effect + SELECTION.even
        if len(other.terms) < len(own.terms) or other.free_count >= own.free_count:
            return 0.0
        changed = [lost for t, lost in lost_of.items() if not _has_same_form(t, own, other)]
        return EXCHANGE.general_ahead * max(changed, default=0.0)

    return tolerance


def plausible_simplifications(
    comparison: ModelComparison,
    best: ScoredModel,
    linear: Linearization | None,
    others: Sequence[Hypothesis],
    tolerance: Callable[[Hypothesis], float],
) -> list[Hypothesis]:
    """Simplifications that the linearized motion does not clearly reject, with its parameters.

    Those that remove an elastic transmission are always among them.
    """
    elastic_terms = {t for t in best.hypothesis.terms if t.law.is_elastic_transmission}
    linearized = [h for h in others if elastic_terms <= set(h.terms)]
    if linear is None or not linearized:
        return list(others)
    view = residual_view(best, linear.residual(best.fitted.residual))
    fitted, evidence = fit_and_score_linearized(
        linear, view, best, linearized, comparison.penalty_per_effect
    )
    return [h for h in others if not elastic_terms <= set(h.terms)] + [
        h for h, e in zip(fitted, evidence, strict=True) if e + tolerance(h) > -SELECTION.clear
    ]


def have_same_forms(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether two hypotheses have the same terms in the same forms."""
    same = set(one.terms) == set(other.terms)
    return same and all(_has_same_form(t, one, other) for t in one.terms)


def _has_same_form(term: Term, own: Hypothesis, other: Hypothesis) -> bool:
    """Whether ``other`` has a term in the same form as ``own``."""
    if term not in other.terms:
        return False
    here, there = own.theta[own.slice_of(term)], other.theta[other.slice_of(term)]
    return bool(np.array_equal(term.is_estimated(here), term.is_estimated(there)))
