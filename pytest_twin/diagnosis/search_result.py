"""The result of a search: the effects that carry a name, with residuals, errors and verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import residuals_everywhere
from pytest_twin.diagnosis.findings import Explanation, build_explanation, joint_unit
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.search.posterior import NamedModel
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import UNSEEN, JointError, Verdict, verdict
from pytest_twin.estimation.hypothesis import EMPTY


@dataclass(frozen=True, slots=True)
class SearchResult:
    """The result of one search.

    Attributes:
        prepared, trials: the problem, and its recordings.
        candidate_count: number of effects among which the search chose.
        explanation: the findings.
        before, after: (samples, signals) residuals over all segments.
        errors: joint -> prediction errors on held-out recordings, or on all without any.
    """

    prepared: PreparedProblem
    trials: TrialSet
    candidate_count: int
    explanation: Explanation
    before: FloatArray
    after: FloatArray
    errors: Mapping[str, JointError]
    verdict: Verdict


def build_result(
    prepared: PreparedProblem, trials: TrialSet, named: NamedModel, candidate_count: int
) -> SearchResult:
    """The result of the effects that carry a name: findings, residuals, errors and verdict."""
    problem = prepared.problem
    explanation = build_explanation(prepared, named, (*trials.fit, *trials.held_out))
    before, after = (residuals_everywhere(problem, h) for h in (EMPTY, explanation.hypothesis))
    errors = joint_errors(prepared, before, after)
    outcome = verdict(errors, explanation.findings)
    return SearchResult(
        prepared, trials, candidate_count, explanation, before, after, errors, outcome
    )


def joint_errors(
    prepared: PreparedProblem, before: FloatArray, after: FloatArray
) -> dict[str, JointError]:
    """Joint -> RMS errors on held-out recordings, or on all where none is held out.

    Args:
        before, after: (samples, signals) residuals over all segments, without and with effects.
    """
    problem = prepared.problem
    inside = problem.is_in_test
    travel = np.ptp(
        np.concatenate([problem.simulator.segments[s].position for s in problem.tested_segments]),
        axis=0,
    )
    found = {}
    for j, joint in enumerate(problem.joints):
        if problem.floor[j] >= UNSEEN:
            continue
        rms = [float(np.sqrt(np.mean(r[inside, j] ** 2))) for r in (before, after)]
        floor, unit = float(problem.floor[j]), joint_unit(problem, j)
        found[joint] = JointError(rms[0], rms[1], floor, unit, float(travel[j]))
    return found
