"""Which of several rivals a search goes on from."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.diagnosis.fit import Fitted
from pytest_twin.diagnosis.hypothesis import EMPTY, Term
from pytest_twin.diagnosis.search.scored_model import (
    Place,
    ScoredModel,
    SelectedModel,
    simplest_good_model,
)

COULOMB, VISCOUS = Term("coulomb_friction", 0), Term("viscous_friction", 0)
STRIBECK, GAIN = Term("stribeck_friction", 0), Term("controller_gain", 0)


def rival(evidence: float, *terms: Term) -> ScoredModel:
    hypothesis = EMPTY
    for term in terms:
        hypothesis = hypothesis.with_term(term, np.zeros(len(term.parameters)))
    none = np.zeros((1, 1))
    return ScoredModel(Fitted(hypothesis, none, none[..., None], 0.0), none, evidence)


@pytest.mark.parametrize(
    ("rivals", "chosen"),
    [
        # A second name for a sixth more of the evidence follows anything: one is enough.
        ([rival(170.0, GAIN, VISCOUS), rival(143.0, COULOMB)], (COULOMB,)),
        # Two that explain what neither does are both needed.
        ([rival(300.0, GAIN, VISCOUS), rival(143.0, COULOMB)], (GAIN, VISCOUS)),
        # Among laws of one name the better one, unless a simpler one is as good.
        ([rival(1000.0, STRIBECK), rival(850.0, COULOMB)], (STRIBECK,)),
        ([rival(1000.0, STRIBECK), rival(995.0, COULOMB)], (COULOMB,)),
        ([rival(12.0, STRIBECK), rival(8.0, COULOMB)], (COULOMB,)),
    ],
)
def test_the_simplest_that_is_as_good(rivals: list[ScoredModel], chosen: tuple[Term, ...]) -> None:
    assert simplest_good_model(rivals).hypothesis.terms == chosen


def test_how_sure_a_name_is_comes_of_what_could_stand_in_its_place() -> None:
    selected = SelectedModel(rival(0.0, COULOMB, GAIN), rival(0.0))
    evidence: dict[Place, float] = {
        ((COULOMB,), VISCOUS): -np.log(4.0),
        ((COULOMB,), None): -np.log(4.0),
        # What has it in it says the same; what stands for both is held against neither alone.
        ((COULOMB,), STRIBECK): 50.0,
        ((COULOMB, GAIN), VISCOUS): 50.0,
    }
    selected.weigh(evidence)
    assert selected.confidence[COULOMB] == pytest.approx(1.0 / 1.5)
    assert selected.alternatives[COULOMB] == [(VISCOUS, pytest.approx(0.25 / 1.5))]
    assert selected.confidence[GAIN] == 1.0
    assert selected.alternatives[GAIN] == []
