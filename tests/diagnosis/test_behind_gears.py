"""Gears that give: found where the motion along which laws are read off says little of them."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import ELBOW, link, problem_of

from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.compensated_starts import compensated
from pytest_twin.diagnosis.search.linearized_shortlist import linearized_shortlist
from pytest_twin.diagnosis.search.linearized_view import linearize_for_additions
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.simulation_shortlist import simulation_shortlist
from pytest_twin.diagnosis.search.trial_simulation import TrialSimulation

PLAY, FRICTION, LATE = (
    Term(effect, ELBOW) for effect in ("backlash", "asymmetric_friction", "command_delay")
)
TEETH = {"gap": 0.04, "tooth_compliance": 1e-4}
DRY = {"coulomb": 0.25, "offset": 0.15}


def with_true(problem: Problem, term: Term, values: dict[str, float]) -> Hypothesis:
    theta = [values[p.name] / problem.scales.value(p, term.joint) for p in term.parameters]
    return EMPTY.with_term(term, np.array(theta))


def fitted(comparison: ModelComparison, hypothesis: Hypothesis) -> ScoredModel:
    weights = comparison.weights(comparison.nominal)
    return comparison.rivals([hypothesis], weights, 0, slopes=True)[0]


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {PLAY: TEETH, FRICTION: DRY})


def test_what_acts_on_a_motor_behind_play_is_simulated(problem: Problem) -> None:
    comparison = ModelComparison(problem)
    best = fitted(comparison, with_true(problem, PLAY, TEETH))
    look = linearize_for_additions(problem, best)
    assert look.linear is None
    found = linearized_shortlist(comparison, best, look)
    assert found is not None
    assert (PLAY, FRICTION) in {h.terms for h in simulation_shortlist(problem, best, look, found)}
    # Where no gear is named nothing but the laws along the motion is asked.
    assert linearize_for_additions(problem, fitted(comparison, EMPTY)).linear is not None


def test_play_beside_what_explains_more_is_tried_by_simulation() -> None:
    late = {"delay": 0.03}
    problem = problem_of("position", {LATE: late, PLAY: {"gap": 0.02, "tooth_compliance": 1e-4}})
    comparison = ModelComparison(problem)
    best = fitted(comparison, with_true(problem, LATE, late))
    look = linearize_for_additions(problem, best)
    found = linearized_shortlist(comparison, best, look)
    assert found is not None
    assert PLAY in {h.terms[-1] for h in simulation_shortlist(problem, best, look, found)}


GIVES, LINK = Term("joint_elasticity", ELBOW), Term("inertial_parameters", ELBOW)
SOFT = {"compliance": 1.0 / 12.0, "damping_time": 0.01}


def tried(problem: Problem, best: ScoredModel) -> list[Hypothesis]:
    left = np.mean(best.fitted.residual**2, axis=0)
    return compensated(TrialSimulation(problem, best, left), best.hypothesis)


def test_a_heavier_link_is_tried_with_its_gear_as_much_stiffer() -> None:
    error = 0.4
    problem = problem_of("position", {GIVES: SOFT, LINK: link(0, relative_error=error)})
    comparison = ModelComparison(problem)
    # The stiffness at which a link as the model has it swings as the real one does.
    servo = 1.0 / problem.simulator.models.world(problem.fit).stiffness[0, ELBOW]
    swings = SOFT | {"compliance": (SOFT["compliance"] + servo) * (1.0 + error) - servo}
    best = fitted(comparison, with_true(problem, GIVES, swings))
    (found,) = tried(problem, best)
    truth = with_true(problem, GIVES, SOFT).theta
    assert found.terms == (GIVES, LINK)
    assert found.theta[:2] == pytest.approx(truth, rel=0.02)
    assert found.theta[found.slice_of(LINK)][0] == pytest.approx(error, rel=0.02)
    look = linearize_for_additions(problem, best)
    seen = linearized_shortlist(comparison, best, look)
    assert seen is not None
    (start,) = (
        h for h in simulation_shortlist(problem, best, look, seen) if h.terms == found.terms
    )
    assert start.theta[:2] == pytest.approx(truth, rel=0.05)
    # With a link that is right, or named, or without a gear nothing of it is tried.
    right = problem_of("position", {GIVES: SOFT})
    fits = fitted(ModelComparison(right), with_true(right, GIVES, SOFT))
    assert tried(right, fits) == []
    assert tried(problem, fitted(comparison, found)) == []
    assert tried(problem, fitted(comparison, EMPTY)) == []
