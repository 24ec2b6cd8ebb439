"""The unexplained residual: which joints cause it, when, and in which regime."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.locate import (
    TimeAndRegime,
    frequencies,
    missing_force,
    motions,
    place_of,
)
from pytest_twin.diagnosis.locate_settings import LOCATE
from pytest_twin.diagnosis.prepare import NOISE, Prepared
from pytest_twin.diagnosis.search_result import SearchResult, residuals_everywhere
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


def unexplained(
    diagnosed: SearchResult, near: Prepared, trials: TrialSet
) -> dict[str, UnexplainedResidual]:
    """The joints at which a force is missing, the largest signal-to-noise ratio first.

    Args:
        diagnosed: the findings on the recordings on which they are tested.
        near: problem in which the missing force is computed. If predictions of whole recordings
            diverge it consists of short windows, because the force is computed for small
            deviations.
        trials: recordings of ``near``.
    """
    errors, problem = diagnosed.errors, near.problem
    whole = motions(diagnosed.prepared, (*diagnosed.trials.fit, *diagnosed.trials.held_out))
    paths, after = whole, diagnosed.after
    if near is not diagnosed.prepared:
        paths = motions(near, (*trials.fit, *trials.held_out))
        after = residuals_everywhere(problem, diagnosed.explained.hypothesis)
    force = missing_force(problem, after, near.floor_parts[NOISE])
    strength = force.strength
    found: dict[str, UnexplainedResidual] = {}

    def add(j: int, blame: FloatArray) -> None:
        joint = problem.joints[j]
        where = place_of(paths, np.nan_to_num(blame), j, errors[joint].unit)
        band = frequencies(whole, diagnosed.after[:, j], j)
        if band is not None:
            where = replace(where, summary=f"{where.summary}; {band}")
        found[joint] = UnexplainedResidual(errors[joint].fraction, where)

    clear = max(LOCATE.cause * float(strength.max(initial=0.0)), 1e-9)
    for j in sorted(map(int, np.flatnonzero(strength >= clear)), key=lambda j: -strength[j]):
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
