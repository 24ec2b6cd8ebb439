"""Effects that a model has from the start: candidates are in addition to them."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import ELBOW, problem_of, sensitivities

from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.estimation.hypothesis import EMPTY, Term, effect_values

GAIN = Term("controller_gain", ELBOW)
ZERO = Term("encoder_bias", ELBOW)


def with_fixed(term: Term, theta: list[float]) -> Problem:
    """The arm with an effect, which its model has from the start."""
    names = (p.name for p in term.parameters)
    problem = problem_of("position", {term: dict(zip(names, theta, strict=True))})
    own = EMPTY.with_term(term, np.array(theta))
    simulator = BatchSimulator(
        problem.simulator.segments, problem.joints, threads=1,
        fixed=effect_values([own], len(problem.joints), problem.scales),
    )  # fmt: skip
    return problem.with_simulator(simulator, None).at(EMPTY)


@pytest.mark.parametrize(
    ("term", "fixed", "added"),
    [(GAIN, [-0.5, 0.0], [-0.02, 0.0]), (ZERO, [0.1, 0.0], [0.01, 0.0])],
    ids=["gain", "joint zero"],
)
def test_a_candidate_is_in_addition_to_the_same_effect_of_the_model(
    term: Term, fixed: list[float], added: list[float]
) -> None:
    problem = with_fixed(term, fixed)
    found, _ = sensitivities(problem, [term])
    linear = found[0].change[:, :, 0] / found[0].start[found[0].amplitude_indices[0]]
    without, with_it = problem.residuals([EMPTY, EMPTY.with_term(term, np.array(added))],
                                         problem.fit)  # fmt: skip
    simulated = bins(problem, problem.fit).mean(without - with_it) / added[0]
    difference = np.sqrt(np.mean((linear - simulated) ** 2))
    assert difference < 0.15 * np.sqrt(np.mean(simulated**2))
