"""A linearization is kept for the next one who asks, and never used for another question."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from test_elastic_transmissions import single_effect
from test_first_order import ELBOW, problem_of

from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.law_forces import LawForces
from pytest_twin.diagnosis.first_order.sensitivities import Linearization, linearize
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

DRAG = Term("viscous_friction", ELBOW)


@pytest.fixture
def problem() -> Problem:
    return problem_of("position", {DRAG: {"coefficient": 0.2}})


@pytest.fixture
def found(problem: Problem) -> Hypothesis:
    return single_effect(problem, DRAG, {"coefficient": 0.2})


def linearized(problem: Problem, hypothesis: Hypothesis) -> Linearization:
    linear = linearize(problem, problem.fit, hypothesis)
    assert linear is not None
    return linear


def with_another_theta(problem: Problem, found: Hypothesis) -> tuple[Problem, Hypothesis]:
    return problem, found.with_theta(found.theta * (1.0 + 1e-12))


def with_another_step_error(problem: Problem, found: Hypothesis) -> tuple[Problem, Hypothesis]:
    return replace(problem, discretization_error=dict(problem.discretization_error)), found


def with_a_stuck_encoder(problem: Problem, found: Hypothesis) -> tuple[Problem, Hypothesis]:
    floor = problem.floor.copy()
    floor[ELBOW] = 1e9
    return replace(problem, floor=floor), found


def test_the_same_question_has_the_same_answer_and_the_same_count_of_steps(
    problem: Problem, found: Hypothesis, monkeypatch: pytest.MonkeyPatch
) -> None:
    terms = [t for t in candidates(problem) if t != DRAG]
    counts = [problem.simulated_steps]
    first = linearized(problem, found)
    counts.append(problem.simulated_steps)
    sensitivities = first.sensitivities(terms)
    assert len(sensitivities) > 20

    def changed(*_: object) -> None:
        raise AssertionError("computed again")

    with monkeypatch.context() as m:
        m.setattr(LawForces, "changes", changed)
        again = linearized(problem, found.with_theta(found.theta.copy()))
        counts.append(problem.simulated_steps)
        assert again is first
        assert again.sensitivities(terms) == sensitivities
    assert counts[2] - counts[1] == counts[1] - counts[0] > 0
    # Another selection of candidates of one effect is another question.
    (one,) = first.sensitivities([Term("coulomb_friction", ELBOW)])
    assert one.term == Term("coulomb_friction", ELBOW)


@pytest.mark.parametrize("rough", [False, True], ids=["smooth", "rough"])
def test_the_steps_of_a_kept_linearization_are_counted_as_if_it_were_made_again(
    problem: Problem, found: Hypothesis, rough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Hypothesis, "is_discontinuous", property(lambda self: rough))
    linearized(problem, found)

    def count() -> tuple[int, int]:
        before = problem.simulated_steps, problem.cached_steps
        linearized(problem, found)
        return problem.simulated_steps - before[0], problem.cached_steps - before[1]

    kept = count()
    problem.memory.cached = None
    assert count() == kept
    assert kept[0] > 0
    assert (kept[1] > 0) is rough


@pytest.mark.parametrize(
    "change",
    [with_another_theta, with_another_step_error, with_a_stuck_encoder],
)
def test_another_state_of_the_problem_has_another_linearization(
    problem: Problem,
    found: Hypothesis,
    change: Callable[[Problem, Hypothesis], tuple[Problem, Hypothesis]],
) -> None:
    first = linearized(problem, found)
    problem, changed = change(problem, found)
    other = linearized(problem, changed)
    assert other is not first
    assert linearized(problem, EMPTY) is not other
