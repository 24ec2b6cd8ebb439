"""Where a push begins and ends: known from far off, though a slope says little of it."""

from __future__ import annotations

import numpy as np
import pytest
from test_behind_gears import with_true
from test_first_order import SHOULDER, look, problem_of

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis import fit as fit_module
from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
)
from pytest_twin.diagnosis.first_order.linearized_fit import fit_linearized
from pytest_twin.diagnosis.first_order.sensitivities import Sensitivity
from pytest_twin.diagnosis.fit import distant_steps, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.linearized_view import linearize_for_additions
from pytest_twin.diagnosis.search.model_comparison import ModelComparison

PUSH = Term("external_force", SHOULDER)
TRUE = {"effort": 1.0, "start": 2.0, "duration": 0.6}
# s that the grid of a search to first order may be off, that a fit takes back, and that it leaves.
GRID, OFF, NEAR = 0.1, 0.25, 0.01


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {PUSH: TRUE})


def off_by(problem: Problem, seconds: float) -> FloatArray:
    theta = with_true(problem, PUSH, TRUE).theta.copy()
    theta[1] += seconds / problem.scales.value(PUSH.parameters[1], SHOULDER)
    return theta


def start_of(problem: Problem, theta: FloatArray) -> float:
    return float(theta[1]) * problem.scales.value(PUSH.parameters[1], SHOULDER)


def test_a_fit_finds_the_start_of_a_push(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = 1.0 / problem.signal_floor

    def found(seconds: float) -> float:
        start = EMPTY.with_term(PUSH, off_by(problem, seconds))
        (best,) = fit(problem, [start], weights, problem.fit, iterations=6, slopes=False)
        return start_of(problem, best.hypothesis.theta)

    for off in (-OFF, OFF):
        assert found(off) == pytest.approx(TRUE["start"], abs=NEAR)
    # By its slope alone it moves no further than the drive takes to answer, again and again.
    monkeypatch.setattr(fit_module, "_REACHED", ())
    assert abs(found(-OFF) - TRUE["start"]) > NEAR


def test_a_push_is_found_along_the_motion_as_well(problem: Problem) -> None:
    seen = linearize_for_additions(problem, ModelComparison(problem).nominal)
    assert seen.linear is not None
    start = EMPTY.with_term(PUSH, off_by(problem, GRID))
    (found,) = fit_linearized(seen.linear, seen.view, [start], 6)
    assert start_of(problem, found.hypothesis.theta) == pytest.approx(TRUE["start"], abs=NEAR)


def test_what_is_tried_beside_a_slope_stays_inside_its_bounds() -> None:
    early = EMPTY.with_term(PUSH, np.array([1.0, 0.1, 0.1]))
    tried = np.array([h.theta for h in distant_steps(early)])
    (_, start, duration) = PUSH.parameters
    assert (tried[:, 0] == 1.0).all()
    assert tried[:, 1].min() == start.lower
    assert tried[:, 2].min() == duration.lower
    # A law without an edge in time follows its slopes.
    assert distant_steps(EMPTY.with_term(Term("viscous_friction", SHOULDER), np.array([0.1]))) == []


def test_a_pulse_is_not_one_sample() -> None:
    """Of two sizes the one that explains the pulse, though as long as it stands it is worth few
    samples, and another signal's noise many.
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
        Sensitivity(PUSH, np.array([1.0, start, 0.6]), (0,), change[..., None])
        for start, change in ((5.0, wrong), (2.0, right))
    ]
    view = ResidualView(residual, np.empty((bins, 2, 0)), floor, (bins,))
    lens = NormalEquations(view, CandidateSensitivities(responses))
    assert lens.children(lens.bare, 1) == [(1,)]


def test_the_size_of_a_push_that_comes_first_is_the_one_nearest(problem: Problem) -> None:
    lens = look(problem)
    structures = [lens.structure(chosen) for chosen in lens.children(lens.bare, 3)]
    starts = {term: start for s in structures for term, start in s.starts.items()}
    assert start_of(problem, starts[PUSH]) == pytest.approx(TRUE["start"], abs=GRID)
