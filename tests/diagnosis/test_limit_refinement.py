"""Limits of drives at sizes outside the starting grid, and laws with simpler special cases."""

from __future__ import annotations

import numpy as np
import pytest
from searched import named, searched
from test_first_order import ELBOW, SHOULDER, problem_of, rate

from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
    candidates,
)
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.limit_refinement import refine_limits
from pytest_twin.diagnosis.first_order.sensitivities import linearize
from pytest_twin.effects import catalogue
from pytest_twin.effects.proposal import sizes_up_to_bound
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import fit, propose_step


def test_a_limit_between_two_starting_sizes_is_refined_to_its_own_size() -> None:
    """The rate limit is between two starting sizes and causes a large residual."""
    hidden = 1.0 / 0.75
    problem = problem_of("position", {Term("rate_limit", ELBOW): rate(inverse_rate=hidden)})
    linear = linearize(problem, problem.fit, EMPTY)
    assert linear is not None
    residual = problem.residuals([EMPTY], problem.fit)[0]
    binned = bins(problem, problem.fit)
    left = linear.residual(residual)
    view = ResidualView(left, np.zeros((*left.shape, 0)), problem.signal_floor, binned.lengths)
    found = linear.sensitivities(candidates(problem))
    refined = refine_limits(linear, view, CandidateSensitivities(found), EMPTY)
    (mine,) = [r for r in refined if r.term == Term("rate_limit", ELBOW)]
    scale = problem.scales.value(mine.term.parameters[0], ELBOW)
    assert mine.start[0] * scale == pytest.approx(hidden, rel=0.02)
    starting_grid = CandidateSensitivities([r for r in found if r.term == mine.term])
    best = min(
        float(np.mean(NormalEquations(view, starting_grid).structure((i,)).residual[:, ELBOW] ** 2))
        for i in range(len(starting_grid.responses))
    )
    own = float(np.mean((left - mine.change[..., 0])[:, ELBOW] ** 2))
    assert own < 0.2 * best


def test_no_limit_is_refined_for_a_small_residual() -> None:
    problem = problem_of("position", {Term("viscous_friction", SHOULDER): {"coefficient": 1e-4}})
    linear = linearize(problem, problem.fit, EMPTY)
    assert linear is not None
    left = linear.residual(problem.residuals([EMPTY], problem.fit)[0])
    lengths = bins(problem, problem.fit).lengths
    view = ResidualView(left, np.zeros((*left.shape, 0)), problem.signal_floor, lengths)
    assert not refine_limits(
        linear, view, CandidateSensitivities(linear.sensitivities(candidates(problem))), EMPTY
    )


def test_special_cases_are_laws_of_the_catalogue_with_fewer_fitted_parameters() -> None:
    some = 0
    for effect in catalogue().values():
        values = {p.name: 0.3 for p in effect.parameters}
        for simpler, special in effect.special_cases(values).items():
            law = catalogue()[simpler]
            assert set(special) == {p.name for p in law.parameters}
            fitted, more = (sum(not p.choice for p in e.parameters) for e in (law, effect))
            assert fitted < more
            some += 1
    assert some >= 6


def test_a_torque_speed_limit_without_slope_is_simplified_to_a_saturation() -> None:
    """If the limit does not depend on speed, its second parameter has no influence."""
    problem = problem_of("position", {Term("torque_saturation", SHOULDER): {"inverse_limit": 0.25}})
    curve, flat = Term("torque_speed_limit", SHOULDER), Term("torque_saturation", SHOULDER)
    stall = 4.0 / problem.scales.value(curve.parameters[1], SHOULDER)
    found = named(problem, Hypothesis((curve,), np.array([1e-4, stall])))
    assert found.terms == (flat,)
    limit = 1.0 / (found.theta[0] * problem.scales.value(flat.parameters[0], SHOULDER))
    assert limit == pytest.approx(4.0, rel=0.02)


def test_a_fit_does_not_change_a_categorical_parameter() -> None:
    term = Term("encoder_bias", SHOULDER)
    assert term.is_estimated(np.array([0.01, 1.0])).tolist() == [True, False]
    problem = problem_of("position", {term: {"bias": 0.05, "in_loop": 1.0}})
    start = EMPTY.with_term(term, np.array([0.01, 1.0]))
    fitted = fit(problem, [start], 1.0 / problem.floor, problem.fit, iterations=6)[0]
    assert fitted.hypothesis.theta[1] == 1.0
    bias = fitted.hypothesis.theta[0] * problem.scales.value(term.parameters[0], SHOULDER)
    assert bias == pytest.approx(0.05, rel=0.1)


def test_rounding_errors_do_not_change_a_categorical_parameter() -> None:
    """The fit transforms a mass into its moment and back, with rounding errors."""
    term = Term("encoder_bias", SHOULDER)
    h = EMPTY.with_term(Term("payload", -1), np.array([-0.1, 0.7, 0.0, 0.0, 0.0]))
    h = h.with_term(term, np.array([0.3, 0.5]))
    random = np.random.default_rng(2)
    jacobian = random.standard_normal((50, 1, 7)) * [1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    residual = 1e3 * random.standard_normal((50, 1))
    moved = propose_step(h, residual, jacobian, np.ones(1), 1e-4)
    assert moved.theta[6] == 0.5
    assert moved.theta[5] != 0.3
    # Parameters that this form of the payload does not have stay at zero.
    assert not moved.theta[2:5].any()


@pytest.mark.nightly
def test_a_narrow_minimum_outside_the_starting_grid_is_found() -> None:
    """The limit is twice the largest starting size, and its minimum a few per cent wide."""
    term = Term("rate_limit", ELBOW)
    parameter = term.parameters[0]
    hidden = 2.0 * parameter.starts[-1] * 1.07
    scale = problem_of("position", {}).scales.value(parameter, ELBOW)
    problem = problem_of("position", {term: rate(inverse_rate=hidden * scale)})
    hidden *= scale / problem.scales.value(parameter, ELBOW)
    found = searched(problem).incumbent.hypothesis
    assert found.terms == (term,)
    assert found.theta[0] == pytest.approx(hidden, rel=0.02)


def test_sizes_above_the_starting_grid_end_at_the_physical_bound() -> None:
    for law in catalogue().values():
        for size in sizes_up_to_bound(law):
            (lone,) = np.flatnonzero(Term(law.id, 0).is_estimated(size))
            assert law.parameters[lone].starts[-1] < size[lone] <= law.parameters[lone].upper
    limit = sizes_up_to_bound(catalogue()["rate_limit"])
    # Limits of the setpoint rate and of the effort rate have the same number of sizes.
    assert [s[2] for s in limit] == [0.0] * (len(limit) // 2) + [1.0] * (len(limit) // 2)
    assert len(limit) >= 12
