"""Elastic transmissions: candidates are simulated where the linearization does not contain them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from proposed import proposed
from test_first_order import ELBOW, link, problem_of

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.structure_search.search import StructureSearch
from pytest_twin.diagnosis.structure_search.settings import StructureSearchSettings
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

BACKLASH, FRICTION, LATE = (
    Term(effect, ELBOW) for effect in ("backlash", "asymmetric_friction", "command_delay")
)
GAP = {"gap": 0.04, "tooth_compliance": 1e-4}
DRY = {"coulomb": 0.25, "offset": 0.15}


def single_effect(problem: Problem, term: Term, values: dict[str, float]) -> Hypothesis:
    """A hypothesis with one effect that has these values in SI units."""
    theta = [values[p.name] / problem.scales.value(p, term.joint) for p in term.parameters]
    return EMPTY.with_term(term, np.array(theta))


ONE_ROUND = StructureSearchSettings(rounds=1)


def scored_model(comparison: ModelComparison, hypothesis: Hypothesis) -> ScoredModel:
    """A hypothesis, scored at its present parameters."""
    return comparison.fit_models([hypothesis], comparison.nominal, 0, slopes=True)[0]


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {BACKLASH: GAP, FRICTION: DRY})


def test_friction_at_a_joint_with_backlash_is_found(problem: Problem) -> None:
    start = single_effect(problem, BACKLASH, GAP)
    settings = replace(ONE_ROUND, added=1)
    found = StructureSearch(problem, settings=settings).run(start).model.hypothesis
    assert set(found.terms) == {BACKLASH, FRICTION}


def test_backlash_is_found_in_addition_to_an_effect_that_explains_more() -> None:
    late = {"delay": 0.03}
    problem = problem_of(
        "position", {LATE: late, BACKLASH: {"gap": 0.02, "tooth_compliance": 1e-4}}
    )
    found = StructureSearch(problem).run().model.hypothesis
    assert set(found.terms) == {LATE, BACKLASH}


ELASTICITY, LINK = Term("joint_elasticity", ELBOW), Term("inertial_parameters", ELBOW)
COMPLIANT = {"compliance": 1.0 / 12.0, "damping_time": 0.01}


def compensated_pairs(problem: Problem, own: Hypothesis) -> list[Hypothesis]:
    """Proposed hypotheses with another link, best last."""
    return [h for h in proposed(problem, own) if LINK in h.terms and LINK not in own.terms]


def test_a_heavier_link_is_tried_together_with_a_stiffer_transmission() -> None:
    error = 0.4
    problem = problem_of("position", {ELASTICITY: COMPLIANT, LINK: link(0, relative_error=error)})
    comparison = ModelComparison(problem)
    # With this compliance, the nominal link has the resonance of the heavier one.
    servo = 1.0 / problem.simulator.models.world(problem.fit).stiffness[0, ELBOW]
    same_resonance = COMPLIANT | {
        "compliance": (COMPLIANT["compliance"] + servo) * (1.0 + error) - servo
    }
    best = scored_model(comparison, single_effect(problem, ELASTICITY, same_resonance))
    found = compensated_pairs(problem, best.hypothesis)[-1]
    truth = single_effect(problem, ELASTICITY, COMPLIANT).theta
    assert found.terms == (ELASTICITY, LINK)
    assert found.theta[:2] == pytest.approx(truth, rel=0.02)
    assert found.theta[found.slice_of(LINK)][0] == pytest.approx(error, rel=0.02)
    result = StructureSearch(problem, settings=ONE_ROUND).run(best.hypothesis).model.hypothesis
    assert set(result.terms) == set(found.terms)
    assert result.theta[result.slice_of(ELASTICITY)] == pytest.approx(truth, rel=0.05)
    # No pair is tried with the right link, with the pair in the fit, or without a transmission.
    right = problem_of("position", {ELASTICITY: COMPLIANT})
    exact = scored_model(ModelComparison(right), single_effect(right, ELASTICITY, COMPLIANT))
    assert compensated_pairs(right, exact.hypothesis) == []
    assert compensated_pairs(problem, found) == []
    assert compensated_pairs(problem, EMPTY) == []
