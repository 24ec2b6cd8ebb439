"""Elastic transmissions: candidates are simulated where the linearization does not contain them."""

from __future__ import annotations

import numpy as np
import pytest
from searched import ProblemPhysics, searched
from test_first_order import ELBOW, link, problem_of

from pytest_twin.diagnosis.problem import Problem
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


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {BACKLASH: GAP, FRICTION: DRY})


@pytest.mark.nightly
def test_friction_at_a_joint_with_backlash_is_found(problem: Problem) -> None:
    start = single_effect(problem, BACKLASH, GAP)
    found = searched(problem, start).incumbent.hypothesis
    assert set(found.terms) == {BACKLASH, FRICTION}


@pytest.mark.nightly
def test_backlash_is_found_in_addition_to_an_effect_that_explains_more() -> None:
    late = {"delay": 0.03}
    problem = problem_of(
        "position", {LATE: late, BACKLASH: {"gap": 0.02, "tooth_compliance": 1e-4}}
    )
    found = searched(problem).incumbent.hypothesis
    assert set(found.terms) == {LATE, BACKLASH}


ELASTICITY, LINK = Term("joint_elasticity", ELBOW), Term("inertial_parameters", ELBOW)
COMPLIANT = {"compliance": 1.0 / 12.0, "damping_time": 0.01}


def compensated_pairs(problem: Problem, own: Hypothesis) -> list[Hypothesis]:
    """Proposed starts with another link."""
    everywhere = np.ones(len(problem.joints), dtype=bool)
    starts = ProblemPhysics(problem).starts(own, everywhere)
    return [h for _, h in starts if {ELASTICITY, LINK} == {*h.terms} and LINK not in own.terms]


ERROR = 0.4
"""Relative error of the elbow's link."""


def heavier_link() -> tuple[Problem, Hypothesis]:
    """A heavier link on a stiffer transmission; the nominal link with the same resonance."""
    problem = problem_of("position", {ELASTICITY: COMPLIANT, LINK: link(0, relative_error=ERROR)})
    servo = 1.0 / problem.simulator.models.world(problem.fit).stiffness[0, ELBOW]
    same_resonance = COMPLIANT | {
        "compliance": (COMPLIANT["compliance"] + servo) * (1.0 + ERROR) - servo
    }
    return problem, single_effect(problem, ELASTICITY, same_resonance)


def test_a_heavier_link_is_proposed_together_with_a_stiffer_transmission() -> None:
    problem, start = heavier_link()
    pair = min(
        compensated_pairs(problem, start),
        key=lambda h: abs(h.theta[h.slice_of(LINK)][0] - ERROR),
    )
    truth = single_effect(problem, ELASTICITY, COMPLIANT).theta
    assert pair.theta[pair.slice_of(ELASTICITY)] == pytest.approx(truth, rel=0.2)


@pytest.mark.nightly
@pytest.mark.xfail(strict=True, reason="the base link and the gains of its servo imitate the pair")
def test_a_heavier_link_is_found_together_with_a_stiffer_transmission() -> None:
    problem, start = heavier_link()
    found = searched(problem, start).incumbent.hypothesis
    assert set(found.terms) == {ELASTICITY, LINK}
    truth = single_effect(problem, ELASTICITY, COMPLIANT).theta
    assert found.theta[found.slice_of(ELASTICITY)] == pytest.approx(truth, rel=0.05)
    assert found.theta[found.slice_of(LINK)][0] == pytest.approx(ERROR, rel=0.05)
