"""The confidence of the selected effects."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import problem_of

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.scored_model import Place, ScoredModel, SelectedModel
from pytest_twin.estimation.hypothesis import EMPTY, Term
from pytest_twin.estimation.least_squares import FittedModel

COULOMB, VISCOUS = Term("coulomb_friction", 0), Term("viscous_friction", 0)
STRIBECK, GAIN = Term("stribeck_friction", 0), Term("controller_gain", 0)


def scored(problem: Problem, *terms: Term) -> ScoredModel:
    hypothesis = EMPTY
    for term in terms:
        hypothesis = hypothesis.with_term(term, np.zeros(len(term.parameters)))
    none = np.zeros((1, 1))
    return ScoredModel(FittedModel(hypothesis, none, none[..., None], 0.0), none, problem)


def test_the_confidence_of_an_effect_follows_from_the_evidence_of_its_single_alternatives() -> None:
    problem = problem_of("position", {})
    selected = SelectedModel(scored(problem, COULOMB, GAIN), scored(problem))
    evidence: dict[Place, float] = {
        ((COULOMB,), VISCOUS): -np.log(4.0),
        ((COULOMB,), None): -np.log(4.0),
        # A law that contains Coulomb friction is no alternative to it. A replacement of both
        # effects does not lower the confidence of either.
        ((COULOMB,), STRIBECK): 50.0,
        ((COULOMB, GAIN), VISCOUS): 50.0,
    }
    selected.weigh(evidence)
    assert selected.confidence[COULOMB] == pytest.approx(1.0 / 1.5)
    assert selected.alternatives[COULOMB] == [(VISCOUS, pytest.approx(0.25 / 1.5))]
    assert selected.confidence[GAIN] == 1.0
    assert selected.alternatives[GAIN] == []
