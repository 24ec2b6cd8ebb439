"""What may be the step's own is said to be."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import ELBOW, problem_of

from pytest_twin.diagnosis.coarse_step import notes_on_coarse_step
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import REFINE, Problem
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.effects.batch_simulator import BatchSimulator


@pytest.fixture(scope="module")
def soft() -> tuple[Problem, Hypothesis]:
    """A gear that rings at eight steps a radian."""
    term = Term("joint_elasticity", ELBOW)
    size = {"compliance": 1 / 60.0, "damping_time": 0.001}
    problem = problem_of("position", {term: size})
    segments, joints = problem.simulator.segments, problem.joints
    problem.refined = BatchSimulator(segments, joints, threads=1, refine=REFINE)
    theta = [size[p.name] / problem.scales.value(p, ELBOW) for p in term.parameters]
    return problem, EMPTY.with_term(term, np.array(theta))


def assert_doubts(found: list[str], doubted: bool, said: list[str]) -> None:
    """One line that says all of it, or none."""
    assert len(found) == doubted
    for line in found:
        for words in said:
            assert words in line


@pytest.mark.parametrize(
    ("floors", "doubted"),
    [
        pytest.param(1.0, False, id="at the floor"),
        pytest.param(2.5, True, id="above it"),
        pytest.param(1e4, False, id="far more than the step can be off"),
    ],
)
def test_what_is_left_above_the_floor_may_be_the_steps(
    soft: tuple[Problem, Hypothesis], floors: float, doubted: bool
) -> None:
    problem, hypothesis = soft
    problem.refine_at(hypothesis)
    floor = 0.02 * float(abs(problem.discretization_error[0].position[:, ELBOW]).max())
    errors = {"elbow": JointError(1.0, floors * floor, floor, "rad")}
    said = [
        "joint 'elbow'", "time step (2 ms) is", "times the residual",
        "Reduce the model's timestep",
    ]  # fmt: skip
    assert_doubts(notes_on_coarse_step(problem, hypothesis, errors), doubted, said)


@pytest.mark.parametrize(("mismatch", "doubted"), [(1.5, True), (3.0, False)])
def test_what_was_explained_may_be_the_steps(
    soft: tuple[Problem, Hypothesis], mismatch: float, doubted: bool
) -> None:
    """Of a joint that was off by little more than the step is, all may be the step's."""
    problem, hypothesis = soft
    problem.refine_at(hypothesis)
    own = float(np.sqrt(np.mean(problem.discretization_error[0].position[:, ELBOW] ** 2)))
    errors = {"elbow": JointError(mismatch * own, 0.1 * own, 0.1 * own, "rad")}
    said = [
        "time step (2 ms) is",
        "of the model's error; the findings at this joint may come from it",
    ]
    assert_doubts(notes_on_coarse_step(problem, hypothesis, errors), doubted, said)


def test_without_a_finding_nothing_bends_to_it(soft: tuple[Problem, Hypothesis]) -> None:
    problem, _ = soft
    errors = dict.fromkeys(("shoulder", "elbow"), JointError(1.0, 1e-3, 1e-4, "rad"))
    assert notes_on_coarse_step(problem, EMPTY, errors) == []
