"""Trial simulations of candidates in windows with large residuals, and starting values of fits."""

from __future__ import annotations

import numpy as np
import pytest
from test_elastic_transmissions import scored_model, single_effect
from test_first_order import ELBOW, SHOULDER, problem_of

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.alternatives import AlternativeComparison
from pytest_twin.diagnosis.search.cost_screen import CostScreen
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.term_exchange import TermExchange
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import weighted_cost

FORCE = Term("external_force", 0)
DELAY, DRAG = Term("command_delay", ELBOW), Term("viscous_friction", SHOULDER)
BACKLASH, DRY = Term("backlash", ELBOW), Term("coulomb_friction", ELBOW)
MASS, SPRING = Term("payload", -1), Term("joint_spring", SHOULDER)
WEAK = Term("torque_constant", ELBOW)


@pytest.fixture(scope="module")
def with_external_force() -> Problem:
    """A crank in ten windows, with an external force in the third and fourth."""
    return problem_of("effort", {FORCE: {"effort": 0.6, "start": 1.0, "duration": 1.0}})


@pytest.fixture(scope="module")
def with_delay_and_friction() -> Problem:
    return problem_of("position", {DELAY: {"delay": 0.03}, DRAG: {"coefficient": 0.4}})


def test_trial_simulations_use_the_half_of_the_windows_with_the_largest_residuals(
    with_external_force: Problem,
) -> None:
    comparison = ModelComparison(with_external_force)
    nominal = comparison.nominal
    left = np.mean(nominal.fitted.residual**2, axis=0)
    trial = CostScreen(nominal, left)
    assert len(trial.segments) == 5
    assert {2, 3} <= set(trial.segments)
    (cost,) = trial.costs([EMPTY])
    (residual,) = with_external_force.residuals([EMPTY], trial.segments)
    assert cost == pytest.approx(weighted_cost(residual, with_external_force.weights(left)))


def test_each_effect_keeps_its_size_with_the_smallest_cost_and_diverging_sizes_are_dropped(
    with_delay_and_friction: Problem,
) -> None:
    comparison = ModelComparison(with_delay_and_friction)
    best = scored_model(comparison, EMPTY)
    left = np.mean(best.fitted.residual**2, axis=0)
    sizes = [EMPTY.with_term(DELAY, np.array([x])) for x in (0.0, 0.03, 0.1)]
    diverging = EMPTY.with_term(Term("armature", ELBOW), np.array([np.nan]))
    (found,) = CostScreen(best, left).best_of_each_term([*sizes, diverging])
    assert found is sizes[1]


def test_a_parameter_at_its_bound_is_detected() -> None:
    (p,) = WEAK.parameters
    assert EMPTY.with_term(WEAK, np.array([p.lower])).is_at_bound(WEAK)
    assert not EMPTY.with_term(WEAK, np.array([0.5 * p.lower])).is_at_bound(WEAK)


def test_a_better_alternative_that_was_not_simulated_is_tried_as_an_addition(
    with_delay_and_friction: Problem,
) -> None:
    """A delay in addition to friction; each alone has a larger residual."""
    comparison = ModelComparison(with_delay_and_friction)
    best = scored_model(
        comparison, single_effect(with_delay_and_friction, DRAG, {"coefficient": 0.4})
    )
    start = EMPTY.with_term(DELAY, np.array([0.02]))

    def added(evidence: float, claimed: Hypothesis = start) -> ScoredModel | None:
        (new,) = claimed.terms
        one = [(TermExchange((DRAG,), new, claimed, evidence, False), best)]
        return AlternativeComparison(comparison).best_addition(best, one, ())

    found = added(100.0)
    assert found is not None
    assert set(found.hypothesis.terms) == {DELAY, DRAG}
    assert found.hypothesis.theta[found.hypothesis.slice_of(DELAY)] == pytest.approx(0.03, abs=1e-3)
    # An alternative with little evidence is not tried, and one without influence not added.
    assert added(10.0) is None
    assert added(100.0, EMPTY.with_term(SPRING, np.array([0.0, 0.0]))) is None
