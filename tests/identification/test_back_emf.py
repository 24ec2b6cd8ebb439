"""A fitted back-EMF is at most the whole damping of its joint, which contains it."""

from __future__ import annotations

import numpy as np
import pytest
from test_further_effects import Drive, by_the_drive_stage, write_trial
from test_identify_simulation import MODEL, NOMINAL

from pytest_twin.diagnosis.passive_joints import impossible, with_largest_back_emf
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.realization import load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.twin import DEFAULT_TOPICS

DAMPING = NOMINAL["damping"]
ROLLOFF, DRAG = Term("torque_rolloff", 0), Term("viscous_friction", 0)
KNEE, BACK_EMF = 2.0, 1.5 * DAMPING


def with_rolloff() -> Drive:
    """A motor whose back-EMF is 1.5 times the damping of the joint in the model."""

    def drive(effort: float, velocity: float) -> float:
        ideal = effort - BACK_EMF * velocity
        return ideal / (1.0 + abs(ideal) / KNEE) + BACK_EMF * velocity

    return drive


def rolloff(problem: Problem, back_emf: float, knee: float = KNEE) -> Hypothesis:
    """A roll-off with a back-EMF in N*m*s/rad and a knee in N*m."""
    knee_scale, scale = (problem.scales.value(p, 0) for p in ROLLOFF.parameters)
    return EMPTY.with_term(ROLLOFF, np.array([1.0 / knee / knee_scale, back_emf / scale]))


def drag(problem: Problem, coefficient: float) -> np.ndarray:
    """An addition to the model's damping, N*m*s/rad."""
    return np.array([coefficient / problem.scales.value(DRAG.parameters[0], 0)])


def back_emf_of(problem: Problem, hypothesis: Hypothesis) -> float:
    at = hypothesis.slice_of(ROLLOFF).start + 1
    return float(hypothesis.theta[at]) * problem.scales.value(ROLLOFF.parameters[1], 0)


def cost(problem: Problem, hypothesis: Hypothesis) -> float:
    """Mean squared residual of the fitted recordings."""
    (residual,) = problem.at(hypothesis).residuals([hypothesis], problem.fit)
    return float(np.mean(residual**2))


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """One recording of the drive."""
    folder = tmp_path_factory.mktemp("drive")
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    model = load(folder / "model.xml")
    path = write_trial(folder / "a.csv", 1, with_rolloff())
    trials = read_trials(
        [path], [], DEFAULT_TOPICS, model.structure,
        RecordingOptions.from_json({"command_between": "held"}),
    )  # fmt: skip
    return prepare(model, trials.fit, trials.held_out, threads=1).problem


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, Hypothesis]:
    result = by_the_drive_stage(tmp_path_factory.mktemp("cell"), with_rolloff)
    return result.prepared.problem, result.hypothesis


@pytest.mark.nightly
def test_the_drive_stage_bounds_the_back_emf_by_the_damping(
    found: tuple[Problem, Hypothesis],
) -> None:
    problem, drive = found
    # Other effects may compensate for a part of what the bound leaves.
    assert ROLLOFF in drive.terms
    # The recordings alone would determine more than the whole damping.
    assert cost(problem, rolloff(problem, BACK_EMF)) < cost(problem, drive)
    assert back_emf_of(problem, drive) == pytest.approx(DAMPING, rel=1e-6)
    assert not impossible(problem, drive)


@pytest.mark.nightly
def test_the_other_parameters_are_fitted_with_the_back_emf_at_its_bound(
    found: tuple[Problem, Hypothesis],
) -> None:
    problem, drive = found
    inverse_knee = ROLLOFF.parameters[0]
    least = 1.0 / (inverse_knee.upper * problem.scales.value(inverse_knee, 0))
    others = [cost(problem, rolloff(problem, DAMPING, k)) for k in np.linspace(least, 3.0, 21)]
    assert cost(problem, drive) < 1.001 * min(others)


@pytest.mark.parametrize("added", [0.0, 0.1, -0.02])
def test_a_back_emf_above_model_and_correction_is_impossible(
    problem: Problem, added: float
) -> None:
    whole = DAMPING + added
    possible = rolloff(problem, whole).with_term(DRAG, drag(problem, added))
    assert not impossible(problem, possible)
    beyond = rolloff(problem, 1.2 * whole).with_term(DRAG, drag(problem, added))
    (why,) = impossible(problem, beyond).items()
    assert why == (
        ROLLOFF,
        f"its back-EMF of {1.2 * whole:.3g} would exceed the total damping of the joint, "
        f"{whole:.3g}",
    )
    bounded = with_largest_back_emf(problem, beyond)
    assert back_emf_of(problem, bounded) == pytest.approx(whole)


def test_friction_that_an_earlier_stage_added_is_part_of_the_damping(problem: Problem) -> None:
    simulator = problem.simulator
    frozen = {**simulator.fixed, "viscous_friction": {"coefficient": np.array([[0.1]])}}
    other = type(simulator)(simulator.segments, simulator.joints, threads=1, fixed=frozen)
    later = problem.with_simulator(other, None)
    hypothesis = rolloff(problem, DAMPING + 0.09)
    assert impossible(problem, hypothesis)
    assert not impossible(later, hypothesis)
