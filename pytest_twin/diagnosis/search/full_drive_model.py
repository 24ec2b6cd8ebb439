"""Fit of all effects that every geared drive has, without a selection.

These are torque constant, torque roll-off, rotor inertia, dry and viscous friction, friction that
depends on load or motor effort, encoder zero and command delay. If all of them differ a little from
the model, no single one exceeds the noise floor, and a search would choose other effects
instead. They are therefore fitted together, in addition to the effects that are already found.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.estimation.hypothesis import Hypothesis, Term

# Fits until convergence, one after another: the weights of the first ones are from large residuals.
_ROUNDS = 3
# Largest confidence of an effect that was not compared with alternatives.
_UNCOMPARED_CONFIDENCE = 0.5


def with_all_drive_terms(problem: Problem, known: Hypothesis, joint: int) -> Hypothesis:
    """A hypothesis with all drive effects of one joint in addition, at their neutral values.

    Args:
        known: the hypothesis; its parameters are kept.
        joint: column of the joint.
    """
    more = known
    for term in candidates(problem):
        if term.law.common_to_geared_motors and term.joint == joint and term not in known.terms:
            more = more.with_term(term, np.array([p.absent_value for p in term.parameters]))
    return more


def fit_all_terms(comparison: ModelComparison, start: Hypothesis) -> ScoredModel:
    """A hypothesis with all parameters fitted by simulation."""
    model = comparison.score_without_fit(start)
    for _ in range(_ROUNDS):
        model = comparison.fit_to_convergence(model)
    return model


def weigh_by_removal(
    comparison: ModelComparison, best: ScoredModel, removal_evidence: Mapping[Term, float]
) -> SelectedModel:
    """A fitted model with confidences from the removal of each effect, at most 50 %.

    Alternatives to the effects were not compared.

    Args:
        comparison: the comparison in which it was fitted.
        removal_evidence: term -> evidence of the fit without it, relative to ``best``.
    """
    selected = SelectedModel(best, comparison.nominal, candidate_count=comparison.candidate_count)
    selected.weigh({((t,), None): evidence for t, evidence in removal_evidence.items()})
    for term, share in selected.confidence.items():
        selected.confidence[term] = min(share, _UNCOMPARED_CONFIDENCE)
    return selected
