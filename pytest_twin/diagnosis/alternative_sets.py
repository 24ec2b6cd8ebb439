"""The final set of effects against other sets, before any confidence is reported."""

from __future__ import annotations

from dataclasses import replace

from pytest_twin.diagnosis.equivalent_sets import compare_sets
from pytest_twin.diagnosis.evidence import log_likelihood
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.refusal import refused
from pytest_twin.diagnosis.run import Run, Scored
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.noise_levels import label
from pytest_twin.diagnosis.search.pruning import prune
from pytest_twin.diagnosis.search_result import SearchResult
from pytest_twin.diagnosis.shared_confidence import share_confidence

_UNCOMPARED = 0.8
"""Greatest confidence of an effect whose set was not compared with others that predict the same. Of
ten recordings of real machines, three had a wrong effect at 92 to 100 % where time ended before."""


def without_alternative_sets(found: SearchResult) -> SearchResult:
    """What was found where time ends before its set is compared: no effect is sure."""
    confidence = {t: min(c, _UNCOMPARED) for t, c in found.selected.confidence.items()}
    return replace(found, selected=replace(found.selected, confidence=confidence))


def with_alternative_sets(
    found: SearchResult, run: Run | None = None
) -> tuple[SearchResult, float]:
    """What was found, or a likelier set, with confidence shared among all sets that predict alike.

    A set with an impossible total, or with a shape that the recordings cannot show, is refused: the
    likeliest other set takes its place, else the rest of it. Where only absolute deviations of
    whole motions can be compared (stick-slip motion), the confidence of the search stays.

    Args:
        found: the search.
        run: gets a step for each set that was simulated.

    Returns:
        The search, and the simulations of all recordings that the comparison took.
    """
    final = found.pruned.fitted.hypothesis
    if not final.terms or found.likelihood is not log_likelihood:
        return found, 0.0
    problem = found.prepared.problem
    recorded = RecordedRange.of(problem)
    run = Run() if run is None else run
    run.begin("comparison with other sets", problem)
    comparison = ModelComparison(problem, run)
    rejected = {*found.pruned.closest}
    compared = compare_sets(
        comparison,
        final,
        lambda h: rejected.isdisjoint(h.terms) and not refused(problem, h, recorded),
    )
    for other in compared.sets:
        run.step(
            problem, "exchange of a set", "rejected",
            f"its predictions differ by at most {other.apart:.3g} floors; it shares the confidence",
            Scored(other.rival.hypothesis, other.evidence), Scored(compared.best.hypothesis, 0.0),
        )  # fmt: skip
    before = replace(found.selected, best=replace(found.selected.best, fitted=found.pruned.fitted))
    selected, pruned = share_confidence(before, compared), found.pruned
    notes = list[str]()
    why = refused(problem, selected.best.hypothesis, recorded)
    while why:
        # No other set predicts as much: the rest stands, and says so.
        notes += [f"rejected: {label(problem, term)}: {reason}" for term, reason in why.items()]
        rest = selected.best.hypothesis.without(*why)
        selected = replace(selected, best=comparison.settled(comparison.scored_without_fit(rest)))
        why = refused(problem, rest, recorded) if rest.terms else {}
    if selected.best.hypothesis.terms != final.terms:
        pruned = prune(problem, selected)
        gone = refused(problem, final, recorded)
        notes[:0] = [
            f"rejected: {label(problem, term)}: {reason}. It compensates for another effect"
            for term, reason in gone.items()
            if not notes
        ]
        pruned.notes[:0] = [*found.pruned.notes, *notes]
    return replace(found, selected=selected, pruned=pruned), compared.simulations
