"""Exchange of one drive limit for another by simulation: a linearization is invalid at a limit."""

from __future__ import annotations

import numpy as np
from test_first_order import ELBOW, problem_of

from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.first_order.sensitivities import starts_in_first_form
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.drive_limits import doubtful_limits, replace_limits
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

PROFILE = {"inverse_rate": 3.0, "inverse_effort_rate": 0.0, "of_effort": 0.0}
SLOW, WEAK = Term("rate_limit", ELBOW), Term("torque_speed_limit", ELBOW)


def with_weak_drive(problem: Problem) -> Hypothesis:
    """A hypothesis whose elbow drive has a torque that decreases to zero at 0.4 rad/s."""
    scale = problem.scales.value(WEAK.parameters[0], ELBOW)
    return EMPTY.with_term(WEAK, np.array([1.0 / (0.4 * scale), 1.0]))


def test_a_wrong_torque_speed_limit_is_replaced_by_the_true_rate_limit() -> None:
    problem = problem_of("position", {SLOW: PROFILE})
    comparison = ModelComparison(problem)
    best = comparison.fit_to_convergence(comparison.score_without_fit(with_weak_drive(problem)))
    assert best.max_mean_square[ELBOW] > (5.0 * problem.floor[ELBOW]) ** 2
    assert doubtful_limits(best) == [WEAK]
    (other,) = replace_limits(best, [WEAK])
    assert other.terms == (SLOW,)
    assert abs(other.theta[0] * problem.scales.value(SLOW.parameters[0], ELBOW) - 3.0) < 0.1


def test_the_search_continues_with_the_better_limit_and_exchanges_each_limit_once() -> None:
    problem = problem_of("position", {SLOW: PROFILE})
    selection = EffectSelection(problem)
    best = selection.comparison.fit_to_convergence(
        selection.comparison.score_without_fit(with_weak_drive(problem))
    )
    better = selection.exchange_limits(best)
    assert better is not None
    assert better.hypothesis.terms == (SLOW,)
    assert better.max_mean_square[ELBOW] < (1.5 * problem.floor[ELBOW]) ** 2
    assert selection.exchange_limits(best) is None


def test_a_limit_with_a_residual_at_the_noise_floor_is_not_exchanged() -> None:
    problem = problem_of("position", {SLOW: PROFILE})
    comparison = ModelComparison(problem)
    size = 3.0 / problem.scales.value(SLOW.parameters[0], ELBOW)
    best = comparison.fit_to_convergence(
        comparison.score_without_fit(EMPTY.with_term(SLOW, np.array([size, 0.0, 0.0])))
    )
    assert doubtful_limits(best) == []


def test_only_limits_of_the_drive_are_exchanged_as_limits() -> None:
    problem = problem_of("position", {SLOW: PROFILE})
    comparison = ModelComparison(problem)
    limits = ["rate_limit", "torque_saturation", "torque_speed_limit"]
    others = ["cogging", "external_force", "joint_coupling", "viscous_friction"]
    sizes = {Term(e, ELBOW): starts_in_first_form(Term(e, ELBOW))[0] for e in limits + others}
    best = comparison.score_without_fit(EMPTY.with_terms(sizes))
    assert [t.effect for t in doubtful_limits(best)] == limits
