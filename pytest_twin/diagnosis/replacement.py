"""Another set of effects where one of the chosen set was only the closest known effect.

Pruning rejects an effect that follows what acts at a joint but is not it: a law of position with
the wrong shape, a parameter at its physical bound. Another effect that explains as much may be the
right one. The search refused it only because the rejected one explained a little more.
"""

from __future__ import annotations

from dataclasses import replace

from pytest_twin.diagnosis.equivalent_sets import compare_sets
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.refusal import reportable_without
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.pruning import PrunedModel, prune
from pytest_twin.diagnosis.search.scored_model import SelectedModel
from pytest_twin.diagnosis.search.settings import SELECTION
from pytest_twin.diagnosis.shared_confidence import share_confidence


def replace_closest_known(
    problem: Problem, comparison: ModelComparison, selected: SelectedModel, pruned: PrunedModel
) -> tuple[SelectedModel, PrunedModel]:
    """The likeliest set without the rejected effects, where it explains as much as they did.

    It must be as likely as the chosen set to within the odds by which the search accepts an effect,
    with model error included, and must keep more effects after pruning than the present set.

    Args:
        pruned: the set after pruning.

    Returns:
        The other set before and after pruning; or the given sets.
    """
    if not pruned.closest:
        return selected, pruned
    allowed = reportable_without(problem, pruned.closest, RecordedRange.of(problem))
    compared = compare_sets(comparison, selected.best.hypothesis, allowed)
    other = compared.best.hypothesis
    if not allowed(other) or not other.terms or compared.gain < -SELECTION.earns:
        return selected, pruned
    chosen = share_confidence(selected, compared)
    left = prune(problem, chosen)
    if len(left.fitted.hypothesis.terms) <= len(pruned.fitted.hypothesis.terms):
        return selected, pruned
    left = replace(
        left, notes=[*pruned.notes, *left.notes], closest=(*pruned.closest, *left.closest)
    )
    return chosen, left
