"""All that every drive has, at once.

A motor behind a gear has a constant of its own, effort that falls with current, a rotor's inertia,
dry and viscous friction, friction by its load and by its own effort, a zero, and a command that
takes its time. Where all of them are off a little, none stands out alone, and a search that adds
one name after another takes something else in their place. Here none is chosen: they are fitted
together, beside what is known already.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel

# Fits to the end, one after another: the first few go by what is large.
_ROUNDS = 3
# Of a name of which nobody asked what else could stand in its place.
_UNWEIGHED = 0.5


def with_all_drive_terms(problem: Problem, known: Hypothesis, joint: int) -> Hypothesis:
    """What is known, and what every drive has at a joint, each law at nothing.

    Args:
        problem: what to explain.
        known: stays as it is.
        joint: column.
    """
    more = known
    for term in candidates(problem):
        if term.law.common_to_geared_motors and term.joint == joint and term not in known.terms:
            more = more.with_term(term, np.array([p.absent for p in term.parameters]))
    return more


def fit_all_terms(comparison: ModelComparison, start: Hypothesis) -> ScoredModel:
    """A hypothesis fitted, all of it."""
    rival = comparison.scored_without_fit(start)
    for _ in range(_ROUNDS):
        rival = comparison.settled(rival)
    return rival


def weigh_by_removal(
    comparison: ModelComparison, best: ScoredModel, absent: Mapping[Term, float]
) -> SelectedModel:
    """A fitted model with confidences from the removal of each effect, at most 50 %.

    Alternatives to the effects were not compared.

    Args:
        comparison: where it was fitted.
        best: the fit.
        absent: evidence, over it, of the residual without each of its terms.
    """
    selected = SelectedModel(best, comparison.nominal, tried=comparison.tried)
    selected.weigh({((t,), None): evidence for t, evidence in absent.items()})
    for term, share in selected.confidence.items():
        selected.confidence[term] = min(share, _UNWEIGHED)
    return selected
