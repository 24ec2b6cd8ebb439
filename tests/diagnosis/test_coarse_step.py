"""Notes where the integration error of the time step may cause a residual or a finding."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import ELBOW, problem_of

from pytest_twin.diagnosis.coarse_step import notes_on_coarse_step
from pytest_twin.diagnosis.problem import REFINE, Problem
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term


@pytest.fixture(scope="module")
def elastic_elbow() -> tuple[Problem, Hypothesis]:
    """An elastic transmission that oscillates with eight time steps per radian, and its effect."""
    term = Term("joint_elasticity", ELBOW)
    size = {"compliance": 1 / 60.0, "damping_time": 0.001}
    problem = problem_of("position", {term: size})
    segments, joints = problem.simulator.segments, problem.joints
    refined = BatchSimulator(segments, joints, threads=1, refine=REFINE)
    problem = problem.with_simulator(problem.simulator, refined)
    theta = [size[p.name] / problem.scales.value(p, ELBOW) for p in term.parameters]
    return problem, EMPTY.with_term(term, np.array(theta))


def assert_note(found: list[str], has_note: bool, phrases: list[str]) -> None:
    """One note with all of these phrases, or no note."""
    assert len(found) == has_note
    for line in found:
        for words in phrases:
            assert words in line


@pytest.mark.parametrize(
    ("floors", "has_note"),
    [
        pytest.param(1.0, False, id="residual at the floor"),
        pytest.param(2.5, True, id="residual above the floor"),
        pytest.param(1e4, False, id="residual above the integration error"),
    ],
)
def test_a_residual_that_the_integration_error_exceeds_has_a_note(
    elastic_elbow: tuple[Problem, Hypothesis], floors: float, has_note: bool
) -> None:
    problem, hypothesis = elastic_elbow
    problem = problem.at(hypothesis)
    floor = 0.02 * float(abs(problem.discretization_error[0].position[:, ELBOW]).max())
    errors = {"elbow": JointError(1.0, floors * floor, floor, "rad")}
    phrases = [
        "joint 'elbow'", "time step (2 ms) is", "times the residual",
        "Reduce the model's timestep",
    ]  # fmt: skip
    assert_note(notes_on_coarse_step(problem, hypothesis, errors), has_note, phrases)


@pytest.mark.parametrize(
    ("mismatch", "has_note"),
    [(1.5, True), (3.0, False)],
    ids=["two thirds of the nominal error", "a third of the nominal error"],
)
def test_findings_have_a_note_if_the_integration_error_explains_half_of_the_nominal_error(
    elastic_elbow: tuple[Problem, Hypothesis], mismatch: float, has_note: bool
) -> None:
    """``mismatch`` is the error of the nominal model, in integration errors."""
    problem, hypothesis = elastic_elbow
    problem = problem.at(hypothesis)
    own = float(np.sqrt(np.mean(problem.discretization_error[0].position[:, ELBOW] ** 2)))
    errors = {"elbow": JointError(mismatch * own, 0.1 * own, 0.1 * own, "rad")}
    phrases = [
        "time step (2 ms) is",
        "of the model's error; the findings at this joint may come from it",
    ]
    assert_note(notes_on_coarse_step(problem, hypothesis, errors), has_note, phrases)


def test_without_findings_there_is_no_note_on_the_time_step(
    elastic_elbow: tuple[Problem, Hypothesis],
) -> None:
    problem, _ = elastic_elbow
    errors = dict.fromkeys(("shoulder", "elbow"), JointError(1.0, 1e-3, 1e-4, "rad"))
    assert notes_on_coarse_step(problem, EMPTY, errors) == []
