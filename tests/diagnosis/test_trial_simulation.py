"""Trial simulations of candidates in windows with large residuals, and starting values of fits."""

from __future__ import annotations

import numpy as np
import pytest
from test_elastic_transmissions import scored_model, single_effect
from test_first_order import ELBOW, SHOULDER, carried, problem_of

from pytest_twin.diagnosis.first_order.beam_search import BeamSearch
from pytest_twin.diagnosis.first_order.linearized_fit import LinearizedFit, fit_linearized
from pytest_twin.diagnosis.first_order.single_term_growth import grow_single_terms
from pytest_twin.diagnosis.fit import weighted_cost
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search import stepwise_selection
from pytest_twin.diagnosis.search.linearized_shortlist import (
    LinearizedShortlist,
    linearized_shortlist,
)
from pytest_twin.diagnosis.search.linearized_view import linearize_for_additions
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.simulation_shortlist import simulation_shortlist
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
from pytest_twin.diagnosis.search.term_exchange import TermExchange
from pytest_twin.diagnosis.search.trial_simulation import TrialSimulation

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
    trial = TrialSimulation(with_external_force, nominal, left)
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
    (found,) = TrialSimulation(with_delay_and_friction, best, left).cheapest([*sizes, diverging])
    assert found is sizes[1]


def test_an_effect_that_a_simulation_ruled_out_is_no_longer_a_candidate() -> None:
    play = {"gap": 0.02, "tooth_compliance": 1e-4}
    problem = problem_of("position", {DELAY: {"delay": 0.03}, BACKLASH: play})
    comparison = ModelComparison(problem)
    best = scored_model(comparison, single_effect(problem, DELAY, {"delay": 0.03}))
    linearized = linearize_for_additions(problem, best)
    found = linearized_shortlist(comparison, best, linearized)
    assert found is not None
    assert BACKLASH in {h.terms[-1] for h in simulation_shortlist(problem, best, linearized, found)}
    reduced = linearized.without({BACKLASH})
    assert BACKLASH not in {r.term for r in reduced.candidate_sensitivities.responses}
    remaining = linearized_shortlist(comparison, best, reduced)
    assert remaining is not None
    assert BACKLASH not in {
        h.terms[-1] for h in simulation_shortlist(problem, best, reduced, remaining)
    }


def test_a_larger_residual_of_the_validation_recordings_makes_an_effect_a_candidate() -> None:
    """Slight viscous friction with strong dry friction hardly reduces the residual of the fit."""
    dry = {"coulomb": 1.5}
    viscous = Term("viscous_friction", ELBOW)
    problem = problem_of("position", {DRY: dry, viscous: {"coefficient": 0.015}})
    comparison = ModelComparison(problem)
    best = scored_model(comparison, single_effect(problem, DRY, dry))
    comparison.has_validation = True
    comparison.nominal.held_residual = comparison.nominal.fitted.residual

    def candidates_with(times: float) -> set[Term]:
        best.held_residual = times * best.fitted.residual
        found = linearized_shortlist(comparison, best, linearize_for_additions(problem, best))
        assert found is not None
        return {h.terms[-1] for h in found.starts}

    assert candidates_with(times=1.0) == set()
    assert viscous in candidates_with(times=10.0)
    # A smaller validation residual has no influence.
    assert candidates_with(times=0.1) == set()


def test_parameters_fitted_by_simulation_are_kept_if_the_linearized_fit_is_worse(
    with_delay_and_friction: Problem,
) -> None:
    comparison = ModelComparison(with_delay_and_friction)
    best = scored_model(comparison, single_effect(with_delay_and_friction, DELAY, {"delay": 0.03}))
    linearized = linearize_for_additions(with_delay_and_friction, best)
    (coefficient,) = DRAG.parameters
    size = 0.4 / with_delay_and_friction.scales.value(coefficient, SHOULDER)
    more = best.hypothesis.with_term(DRAG, np.array([size]))
    inaccurate = more.with_theta(more.theta * np.array([3.0, 1.0]))
    starts = simulation_shortlist(
        with_delay_and_friction,
        best,
        linearized,
        LinearizedShortlist([inaccurate], linearized.view.floor**2, []),
    )
    (mine,) = [h for h in starts if h.terms == more.terms]
    assert mine.theta == pytest.approx(more.theta)


def test_further_effects_are_added_to_an_effect_that_is_already_fitted() -> None:
    """A spring is added to a heavy payload, which keeps its fitted parameters."""
    hidden = {MASS: carried(1.5, 0.2), SPRING: {"stiffness": 6.0, "preload": 0.0}}
    problem = problem_of("position", hidden)
    linearized = linearize_for_additions(problem, ModelComparison(problem).nominal)
    assert linearized.linear is not None
    (root,) = fit_linearized(
        linearized.linear, linearized.view, [single_effect(problem, MASS, hidden[MASS])], 0
    )

    def grown(*polished: LinearizedFit, own: Hypothesis = EMPTY) -> set[frozenset[Term]]:
        def search() -> BeamSearch:
            return BeamSearch(4, 2, 5.0, lambda before, after: True)

        found = grow_single_terms(
            linearized.view, linearized.candidate_sensitivities, polished, own, search
        )
        for h in found:
            assert len(set(h.terms)) == len(h.terms)
            assert h.theta[h.slice_of(MASS)][0] == root.hypothesis.theta[0]
        return {frozenset(h.terms) for h in found}

    assert frozenset({MASS, SPRING}) in grown(root)
    # With the spring in the present fit, every set contains payload, spring and a further effect.
    own = single_effect(problem, SPRING, hidden[SPRING])
    both = LinearizedFit(own.with_term(MASS, root.hypothesis.theta), root.residual)
    with_spring = grown(both, root, own=own)
    assert with_spring
    assert all({MASS, SPRING} < terms for terms in with_spring)
    # No effect is added to one whose parameter is at its bound.
    weak = EMPTY.with_term(WEAK, np.array([WEAK.parameters[0].lower]))
    assert grown(LinearizedFit(weak, root.residual)) == set()


def test_a_parameter_at_its_bound_is_detected() -> None:
    (p,) = WEAK.parameters
    assert EMPTY.with_term(WEAK, np.array([p.lower])).at_bound(WEAK)
    assert not EMPTY.with_term(WEAK, np.array([0.5 * p.lower])).at_bound(WEAK)


def test_the_discretization_error_is_that_of_the_simplest_start_with_the_smallest_residual(
    with_delay_and_friction: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The discretization error depends on the hypothesis for which it is computed."""
    armature, right = (
        Term("armature", ELBOW),
        single_effect(with_delay_and_friction, DELAY, {"delay": 0.03}),
    )
    wrong = EMPTY.with_term(armature, np.array([0.5]))
    both = right.with_term(armature, np.array([0.0]))
    starts = [both, wrong, right]
    selection = StepwiseSelection(with_delay_and_friction)
    refined_at: list[Hypothesis] = []

    def refine_at(problem: Problem, hypothesis: Hypothesis) -> None:
        refined_at.append(hypothesis)

    monkeypatch.setattr(Problem, "refine_at", refine_at)
    monkeypatch.setattr(stepwise_selection, "simulation_shortlist", lambda *_: starts)
    nominal = selection.comparison.nominal
    assert selection.simulated_shortlist(
        nominal, linearize_for_additions(with_delay_and_friction, nominal)
    )
    assert refined_at[0] is right


def test_a_better_alternative_that_was_not_simulated_is_tried_as_an_addition(
    with_delay_and_friction: Problem,
) -> None:
    """A delay in addition to friction; each alone has a larger residual."""
    selection = StepwiseSelection(with_delay_and_friction)
    best = scored_model(
        selection.comparison, single_effect(with_delay_and_friction, DRAG, {"coefficient": 0.4})
    )
    start = EMPTY.with_term(DELAY, np.array([0.02]))

    def added(evidence: float, claimed: Hypothesis = start) -> ScoredModel | None:
        (new,) = claimed.terms
        one = [(TermExchange((DRAG,), new, claimed, evidence, False), best)]
        return selection.best_addition(best, one, ())

    found = added(100.0)
    assert found is not None
    assert set(found.hypothesis.terms) == {DELAY, DRAG}
    assert found.hypothesis.theta[found.hypothesis.slice_of(DELAY)] == pytest.approx(0.03, abs=1e-3)
    # An alternative with little evidence is not tried, and one without influence not added.
    assert added(10.0) is None
    assert added(100.0, EMPTY.with_term(SPRING, np.array([0.0, 0.0]))) is None
