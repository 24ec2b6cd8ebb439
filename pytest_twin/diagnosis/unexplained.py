"""The unexplained residual: which joints cause it, when, and in which regime."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import residuals_everywhere
from pytest_twin.diagnosis.locate import (
    TimeAndRegime,
    compute_missing_force,
    locate_error,
    smooth_motions,
)
from pytest_twin.diagnosis.locate_settings import LOCATE
from pytest_twin.diagnosis.prepare import NOISE, PreparedProblem
from pytest_twin.diagnosis.search_result import SearchResult
from pytest_twin.diagnosis.trials import TrialSet


@dataclass(frozen=True, slots=True)
class UnexplainedResidual:
    """The unexplained residual of one joint.

    Attributes:
        fraction: remaining share of the squared error above the noise floor.
        where: times and regime of motion in which it occurs.
    """

    fraction: float
    where: TimeAndRegime


def locate_unexplained(
    diagnosed: SearchResult, location: PreparedProblem, trials: TrialSet
) -> dict[str, UnexplainedResidual]:
    """The joints at which a force is missing, the largest signal-to-noise ratio first.

    Args:
        diagnosed: the findings on the recordings on which they are tested.
        location: problem in which the missing force is computed. If predictions of whole recordings
            diverge it consists of short windows, because the force is computed for small
            deviations.
        trials: recordings of ``location``.
    """
    errors, problem = diagnosed.errors, location.problem
    motions, after = smooth_motions(location, (*trials.fit, *trials.held_out)), diagnosed.after
    if location is not diagnosed.prepared:
        after = residuals_everywhere(problem, diagnosed.explanation.hypothesis)
    force = compute_missing_force(problem, after, location.floor_parts[NOISE])
    strength = force.strength
    found: dict[str, UnexplainedResidual] = {}

    def add(j: int, squared_error: FloatArray) -> None:
        joint = problem.joints[j]
        where = locate_error(motions, np.nan_to_num(squared_error), j, errors[joint].unit)
        found[joint] = UnexplainedResidual(errors[joint].fraction, where)

    threshold = max(LOCATE.cause * float(strength.max(initial=0.0)), 1e-9)
    for j in sorted(map(int, np.flatnonzero(strength >= threshold)), key=lambda j: -strength[j]):
        if problem.joints[j] in errors and errors[problem.joints[j]].fraction > 0.0:
            add(j, np.maximum((force.force[:, j] / force.noise[j]) ** 2 - 1.0, 0.0))
    if not found:
        # No missing force is above the encoder noise, because the residual is slow. It is then
        # reported at the joints whose position has it.
        for joint, error in errors.items():
            if not error.is_explained:
                j = problem.joints.index(joint)
                add(j, (after[:, j] / problem.floor[j]) ** 2)
    return found
