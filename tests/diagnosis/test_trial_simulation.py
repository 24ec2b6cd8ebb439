"""What is simulated where most is to be explained, and from where fits start."""

from __future__ import annotations

import numpy as np
import pytest
from test_behind_gears import fitted, with_true
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

PUSH = Term("external_force", 0)
LATE, DRAG = Term("command_delay", ELBOW), Term("viscous_friction", SHOULDER)
PLAY, DRY = Term("backlash", ELBOW), Term("coulomb_friction", ELBOW)
MASS, SPRING = Term("payload", -1), Term("joint_spring", SHOULDER)
WEAK = Term("torque_constant", ELBOW)


@pytest.fixture(scope="module")
def pushed() -> Problem:
    """A crank in ten windows, pushed in the third and fourth."""
    return problem_of("effort", {PUSH: {"effort": 0.6, "start": 1.0, "duration": 1.0}})


@pytest.fixture(scope="module")
def late() -> Problem:
    return problem_of("position", {LATE: {"delay": 0.03}, DRAG: {"coefficient": 0.4}})


def test_half_of_the_windows_are_tried_and_those_with_most_to_explain(pushed: Problem) -> None:
    comparison = ModelComparison(pushed)
    nominal = comparison.nominal
    left = np.mean(nominal.fitted.residual**2, axis=0)
    tryout = TrialSimulation(pushed, nominal, left)
    assert len(tryout.segments) == 5
    assert {2, 3} <= set(tryout.segments)
    (cost,) = tryout.costs([EMPTY])
    (residual,) = pushed.residuals([EMPTY], tryout.segments)
    assert cost == pytest.approx(weighted_cost(residual, pushed.weights(left)))


def test_of_every_last_term_the_cheapest_counts_and_none_that_diverges(late: Problem) -> None:
    comparison = ModelComparison(late)
    best = fitted(comparison, EMPTY)
    left = np.mean(best.fitted.residual**2, axis=0)
    sizes = [EMPTY.with_term(LATE, np.array([x])) for x in (0.0, 0.03, 0.1)]
    wild = EMPTY.with_term(Term("armature", ELBOW), np.array([np.nan]))
    (found,) = TrialSimulation(late, best, left).cheapest([*sizes, wild])
    assert found is sizes[1]


def test_what_failed_is_not_offered_again() -> None:
    play = {"gap": 0.02, "tooth_compliance": 1e-4}
    problem = problem_of("position", {LATE: {"delay": 0.03}, PLAY: play})
    comparison = ModelComparison(problem)
    best = fitted(comparison, with_true(problem, LATE, {"delay": 0.03}))
    look = linearize_for_additions(problem, best)
    found = linearized_shortlist(comparison, best, look)
    assert found is not None
    assert PLAY in {h.terms[-1] for h in simulation_shortlist(problem, best, look, found)}
    less = look.without({PLAY})
    assert PLAY not in {r.term for r in less.candidate_sensitivities.responses}
    rest = linearized_shortlist(comparison, best, less)
    assert rest is not None
    assert PLAY not in {h.terms[-1] for h in simulation_shortlist(problem, best, less, rest)}


def test_a_name_counts_for_more_where_what_no_fit_has_seen_keeps_more() -> None:
    """A slight brake beside a strong one: of what is fitted it takes next to nothing."""
    dry = {"coulomb": 1.5}
    slight = Term("viscous_friction", ELBOW)
    problem = problem_of("position", {DRY: dry, slight: {"coefficient": 0.015}})
    comparison = ModelComparison(problem)
    best = fitted(comparison, with_true(problem, DRY, dry))
    comparison.has_validation = True
    comparison.nominal.held_residual = comparison.nominal.fitted.residual

    def offered(times: float) -> set[Term]:
        best.held_residual = times * best.fitted.residual
        found = linearized_shortlist(comparison, best, linearize_for_additions(problem, best))
        assert found is not None
        return {h.terms[-1] for h in found.starts}

    assert offered(times=1.0) == set()
    assert slight in offered(times=10.0)
    # What it keeps less of changes nothing.
    assert offered(times=0.1) == set()


def test_what_was_fitted_by_simulation_is_kept_where_it_strays_along_the_motion(
    late: Problem,
) -> None:
    comparison = ModelComparison(late)
    best = fitted(comparison, with_true(late, LATE, {"delay": 0.03}))
    look = linearize_for_additions(late, best)
    (coefficient,) = DRAG.parameters
    size = 0.4 / late.scales.value(coefficient, SHOULDER)
    more = best.hypothesis.with_term(DRAG, np.array([size]))
    astray = more.with_theta(more.theta * np.array([3.0, 1.0]))
    starts = simulation_shortlist(
        late, best, look, LinearizedShortlist([astray], look.view.floor**2, [])
    )
    (mine,) = [h for h in starts if h.terms == more.terms]
    assert mine.theta == pytest.approx(more.theta)


def test_a_single_term_that_is_fitted_already_gets_its_company() -> None:
    """A heavy payload and a spring: grown from the payload as it is with its law exact."""
    hidden = {MASS: carried(1.5, 0.2), SPRING: {"stiffness": 6.0, "preload": 0.0}}
    problem = problem_of("position", hidden)
    look = linearize_for_additions(problem, ModelComparison(problem).nominal)
    assert look.linear is not None
    (root,) = fit_linearized(look.linear, look.view, [with_true(problem, MASS, hidden[MASS])], 0)

    def grown(*polished: LinearizedFit, own: Hypothesis = EMPTY) -> set[frozenset[Term]]:
        def search() -> BeamSearch:
            return BeamSearch(4, 2, 5.0, lambda before, after: True)

        found = grow_single_terms(look.view, look.candidate_sensitivities, polished, own, search)
        for h in found:
            assert len(set(h.terms)) == len(h.terms)
            assert h.theta[h.slice_of(MASS)][0] == root.hypothesis.theta[0]
        return {frozenset(h.terms) for h in found}

    assert frozenset({MASS, SPRING}) in grown(root)
    # Beside a fit at hand that has the spring, no other comes to it, and the payload alone is none
    # of one more term.
    own = with_true(problem, SPRING, hidden[SPRING])
    both = LinearizedFit(own.with_term(MASS, root.hypothesis.theta), root.residual)
    beside = grown(both, root, own=own)
    assert beside
    assert all({MASS, SPRING} < terms for terms in beside)
    # Nor is a law grown that stands at its bound.
    weak = EMPTY.with_term(WEAK, np.array([WEAK.parameters[0].lower]))
    assert grown(LinearizedFit(weak, root.residual)) == set()


def test_a_law_at_its_bound_is_known_as_such() -> None:
    (p,) = WEAK.parameters
    assert EMPTY.with_term(WEAK, np.array([p.lower])).at_bound(WEAK)
    assert not EMPTY.with_term(WEAK, np.array([0.5 * p.lower])).at_bound(WEAK)


def test_the_step_is_corrected_where_the_simplest_that_leaves_least_is(
    late: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where another is, the error of the step is another's."""
    heavy, right = Term("armature", ELBOW), with_true(late, LATE, {"delay": 0.03})
    wrong = EMPTY.with_term(heavy, np.array([0.5]))
    both = right.with_term(heavy, np.array([0.0]))
    starts = [both, wrong, right]
    selection = StepwiseSelection(late)
    at: list[Hypothesis] = []

    def refine_at(problem: Problem, hypothesis: Hypothesis) -> None:
        at.append(hypothesis)

    monkeypatch.setattr(Problem, "refine_at", refine_at)
    monkeypatch.setattr(stepwise_selection, "simulation_shortlist", lambda *_: starts)
    nominal = selection.comparison.nominal
    assert selection.simulated_shortlist(nominal, linearize_for_additions(late, nominal))
    assert at[0] is right


def test_what_is_better_in_a_place_but_not_simulated_there_is_tried_in_addition(
    late: Problem,
) -> None:
    """A late command beside a brake: each alone is worse, and no more replays are left."""
    selection = StepwiseSelection(late)
    best = fitted(selection.comparison, with_true(late, DRAG, {"coefficient": 0.4}))
    start = EMPTY.with_term(LATE, np.array([0.02]))

    def added(evidence: float, claimed: Hypothesis = start) -> ScoredModel | None:
        (new,) = claimed.terms
        one = [(TermExchange((DRAG,), new, claimed, evidence, False), best)]
        return selection.best_addition(best, one, ())

    found = added(100.0)
    assert found is not None
    assert set(found.hypothesis.terms) == {LATE, DRAG}
    assert found.hypothesis.theta[found.hypothesis.slice_of(LATE)] == pytest.approx(0.03, abs=1e-3)
    # What is hardly ahead along the motion is not tried, and what earns no name is none.
    assert added(10.0) is None
    assert added(100.0, EMPTY.with_term(SPRING, np.array([0.0, 0.0]))) is None
