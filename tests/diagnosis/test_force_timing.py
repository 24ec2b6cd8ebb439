"""Start time and duration of an external force, whose gradients are valid only nearby."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from searched import nominal_view
from test_elastic_transmissions import single_effect
from test_first_order import SHOULDER, normal_equations, problem_of

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
)
from pytest_twin.diagnosis.first_order.linearized_fit import (
    fit_linearized,
    linearized_slopes,
)
from pytest_twin.diagnosis.first_order.sensitivities import Sensitivity
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import batch_division
from pytest_twin.estimation import least_squares as fit_module
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import distant_steps, fit
from pytest_twin.realization import executor, forks

FORCE = Term("external_force", SHOULDER)
TRUE = {"effort": 1.0, "start": 2.0, "duration": 0.6}
# Errors of the start time in s: of the starting grid, one that a fit corrects, one after the fit.
GRID, OFF, NEAR = 0.1, 0.25, 0.01


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {FORCE: TRUE})


def parameters_with_late_start(problem: Problem, seconds: float) -> FloatArray:
    theta = single_effect(problem, FORCE, TRUE).theta.copy()
    theta[1] += seconds / problem.scales.value(FORCE.parameters[1], SHOULDER)
    return theta


def start_time(problem: Problem, theta: FloatArray) -> float:
    return float(theta[1]) * problem.scales.value(FORCE.parameters[1], SHOULDER)


def test_a_fit_finds_the_start_time_of_an_external_force(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = 1.0 / problem.signal_floor

    def found(seconds: float) -> float:
        start = EMPTY.with_term(FORCE, parameters_with_late_start(problem, seconds))
        (best,) = fit(problem, [start], weights, problem.fit, iterations=6, slopes=False)
        return start_time(problem, best.hypothesis.theta)

    for off in (-OFF, OFF):
        assert found(off) == pytest.approx(TRUE["start"], abs=NEAR)
    # With gradient steps only, the fit changes the start time by less than its error.
    monkeypatch.setattr(fit_module, "_REACH_SHARES", ())
    assert abs(found(-OFF) - TRUE["start"]) > NEAR


def test_the_linearized_fit_finds_the_start_time_of_an_external_force(problem: Problem) -> None:
    linearized = nominal_view(problem)
    assert linearized.linear is not None
    start = EMPTY.with_term(FORCE, parameters_with_late_start(problem, GRID))
    (found,) = fit_linearized(linearized.linear, linearized.residual, [start], 6)
    assert start_time(problem, found.hypothesis.theta) == pytest.approx(TRUE["start"], abs=NEAR)


def test_slopes_of_several_cores_equal_those_of_one_and_few_rows_start_no_process(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    linear = nominal_view(problem).linear
    assert linear is not None
    friction = single_effect(problem, Term("viscous_friction", SHOULDER), {"coefficient": 0.1})
    memory = single_effect(
        problem, Term("actuator_lag", SHOULDER), {"time_constant": 0.01, "of_setpoint": 0.0}
    )
    each = [friction, single_effect(problem, FORCE, TRUE), memory]
    processes: list[int] = []

    def slopes(hypotheses: list[Hypothesis], threads: int) -> list[FloatArray]:
        processes.clear()
        monkeypatch.setattr(linear.simulator, "threads", threads)
        return linearized_slopes(linear, hypotheses)

    def in_forks(tasks: Sequence[Callable[[], Any]], count: int) -> list[Any]:
        processes.append(count)
        return forks.in_forks(tasks, count)

    monkeypatch.setattr(executor, "in_forks", in_forks)
    alone = slopes(each, 1)
    assert set(processes) == {1}
    for one, other in zip(alone, slopes(each, 4), strict=True):
        np.testing.assert_array_equal(one, other)
    slopes([friction], 4)
    assert set(processes) == {1}
    monkeypatch.setattr(batch_division, "_FORK_SECONDS", 0.0)
    for one, other in zip(alone, slopes(each, 4), strict=True):
        np.testing.assert_array_equal(one, other)
    assert 4 in processes


def test_distant_steps_of_times_stay_within_their_bounds() -> None:
    hypothesis = EMPTY.with_term(FORCE, np.array([1.0, 0.1, 0.1]))
    tried = np.array([h.theta for h in distant_steps(hypothesis)])
    (_, start, duration) = FORCE.parameters
    assert (tried[:, 0] == 1.0).all()
    assert tried[:, 1].min() == start.lower
    assert tried[:, 2].min() == duration.lower
    # An effect without start time and duration has no distant steps.
    assert distant_steps(EMPTY.with_term(Term("viscous_friction", SHOULDER), np.array([0.1]))) == []


def test_a_pulse_is_preferred_to_an_explanation_of_noise_in_more_samples() -> None:
    """One size explains a pulse, which lasts for few effective samples. The other explains some of
    the noise of another signal, which has many.
    """
    random = np.random.default_rng(3)
    bins, floor = 600, np.ones(2)
    pulse = np.zeros(bins)
    pulse[200:300] = 10.0
    noise = 2.0 * random.standard_normal(bins)
    residual = np.stack([pulse + random.standard_normal(bins), noise], axis=1)
    right = np.stack([pulse, np.zeros(bins)], axis=1)
    wrong = np.stack([np.zeros(bins), 0.5 * noise], axis=1)
    responses = [
        Sensitivity(FORCE, np.array([1.0, start, 0.6]), (0,), change[..., None])
        for start, change in ((5.0, wrong), (2.0, right))
    ]
    view = ResidualView(residual, np.empty((bins, 2, 0)), floor, (bins,))
    equations = NormalEquations(view, CandidateSensitivities(responses))
    assert equations.children(equations.base)[:1] == [(1,)]


def test_the_first_start_time_of_an_external_force_is_the_closest_of_the_grid(
    problem: Problem,
) -> None:
    equations = normal_equations(problem)
    structures = [equations.structure(chosen) for chosen in equations.children(equations.base)[:3]]
    starts = {term: start for s in structures for term, start in s.starts.items()}
    assert start_time(problem, starts[FORCE]) == pytest.approx(TRUE["start"], abs=GRID)
