"""Comparison of the final set of effects with other sets, from which confidences follow."""

from __future__ import annotations

from dataclasses import replace

from pytest_twin.diagnosis.equivalent_sets import compare_sets
from pytest_twin.diagnosis.finding_settings import FINDINGS
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.refusal import refused_effects, reportable_without
from pytest_twin.diagnosis.run import Run, ScoredHypothesis
from pytest_twin.diagnosis.search.linearized_view import linearize_around
from pytest_twin.diagnosis.search.listed_rivals import odds_of_listed_rivals, with_listed_rivals
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.noise_levels import label
from pytest_twin.diagnosis.search.pruning import prune
from pytest_twin.diagnosis.search_result import SearchResult
from pytest_twin.diagnosis.shared_confidence import share_confidence
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.score import log_likelihood

OTHER_SETS = "other sets of effects instead of the final one"
"""Name of the comparison, for the reader."""


def without_comparison(found: SearchResult, run: Run) -> SearchResult:
    """The result if the time ended before its set was compared with others.

    Rivals that the catalogue lists and that the search did not simulate get the share of their
    linearized fit. If there is no time for that either, no confidence is above 50 %.
    """
    final = found.pruned.fitted.hypothesis
    if not final.terms:
        return found
    comparison = ModelComparison(found.prepared.problem, run)
    try:
        with run.budget.fitting():
            best = comparison.score_without_fit(final, slopes=True)
            penalty = comparison.penalty_per_effect
            odds = odds_of_listed_rivals(best, linearize_around(best), penalty)
    except OutOfTime:
        even = {t: min(c, FINDINGS.most_in_doubt) for t, c in found.selected.confidence.items()}
        return replace(found, selected=replace(found.selected, confidence=even))
    return replace(found, selected=with_listed_rivals(found.selected, odds))


def compare_with_other_sets(
    found: SearchResult, run: Run | None = None
) -> tuple[SearchResult, float]:
    """The result with the most likely set of effects, and with confidences against other sets.

    Sets with impossible totals, or with shape parameters that the recordings cannot identify, are
    refused. The most likely other set replaces them, or else the set without the refused effects.
    For whole stick-slip motions the confidence of the search is kept, because only absolute
    deviations can be compared there. If the time ends while sets are fitted, they share the
    confidence by the fit so far, and :func:`without_comparison` adds the others.

    Args:
        run: receives a step for each set that was simulated.

    Returns:
        The result, and the number of simulations of all recordings for the comparison.
    """
    final = found.pruned.fitted.hypothesis
    if not final.terms or found.likelihood is not log_likelihood:
        return found, 0.0
    problem = found.prepared.problem
    recorded = RecordedRange.of(problem)
    run = Run() if run is None else run
    run.begin("comparison with other sets", problem)
    comparison = ModelComparison(problem, run)
    allowed = reportable_without(problem, found.pruned.closest, recorded)
    compared = compare_sets(comparison, final, allowed, found.selected.nearly_as_good)
    for other in compared.sets:
        run.step(
            problem, "exchange of a set", "rejected",
            f"its predictions differ by at most {other.prediction_difference:.3g} floors; it "
            "shares the confidence",
            ScoredHypothesis(other.model.hypothesis, other.evidence),
            ScoredHypothesis(compared.best.hypothesis, 0.0),
        )  # fmt: skip
    before = replace(found.selected, best=replace(found.selected.best, fitted=found.pruned.fitted))
    selected, pruned = share_confidence(before, compared), found.pruned
    notes = list[str]()
    why = refused_effects(problem, selected.best.hypothesis, recorded)
    while why:
        # No other set explains as much: the refused effects are removed, with a note.
        notes += [f"rejected: {label(problem, term)}: {reason}" for term, reason in why.items()]
        kept = selected.best.hypothesis.without(*why)
        selected = replace(
            selected, best=comparison.fit_to_convergence(comparison.score_without_fit(kept))
        )
        why = refused_effects(problem, kept, recorded) if kept.terms else {}
    if selected.best.hypothesis.terms != final.terms:
        if selected.not_simulated:
            # As in the search that ended early: the rest may be an effect that it did not come to.
            selected = replace(selected, not_simulated=frozenset(selected.best.hypothesis.terms))
        pruned = prune(problem, selected)
        removed = refused_effects(problem, final, recorded)
        notes[:0] = [
            f"rejected: {label(problem, term)}: {reason}. It compensates for another effect"
            for term, reason in removed.items()
            if not notes
        ]
        pruned.notes[:0] = [*found.pruned.notes, *notes]
    out = replace(found, selected=selected, pruned=pruned)
    if not compared.is_complete:
        run.skip(f"{OTHER_SETS} (begun, not finished)")
        out = without_comparison(out, run)
    return out, compared.simulations
