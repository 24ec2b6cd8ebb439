"""What stays unexplained: the joints that are the cause, when and in which regime."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.locate import Where, frequencies, missing_force, motions, place_of
from pytest_twin.diagnosis.prepare import NOISE, Prepared
from pytest_twin.diagnosis.searched import Searched, left_everywhere
from pytest_twin.diagnosis.trials import TrialSet

# A joint whose missing force stands out this much less than the clearest one only shows it.
_CAUSE = 0.4


@dataclass(frozen=True, slots=True)
class Left:
    """What stays unexplained at one joint.

    Attributes:
        fraction: of the squared mismatch.
        where: when and in which regime.
    """

    fraction: float
    where: Where


def unexplained(diagnosed: Searched, near: Prepared, trials: TrialSet) -> dict[str, Left]:
    """The joints whose own force is missing, the clearest first.

    Args:
        diagnosed: what was found.
        near: the problem by which what is left is found in time and pose: in windows, where whole
            motions part from what was recorded. What a small deviation would need is no force that
            is missing where the simulated arm is somewhere else by then.
        trials: of that.
    """
    errors, problem = diagnosed.errors, near.problem
    whole = motions(diagnosed.prepared, (*diagnosed.trials.fit, *diagnosed.trials.held_out))
    paths, after = whole, diagnosed.after
    if near is not diagnosed.prepared:
        paths = motions(near, (*trials.fit, *trials.held_out))
        after = left_everywhere(problem, diagnosed.explained.hypothesis)
    force = missing_force(problem, after, near.floor_parts[NOISE])
    strength = force.strength
    found: dict[str, Left] = {}

    def add(j: int, blame: FloatArray) -> None:
        joint = problem.joints[j]
        where = place_of(paths, np.nan_to_num(blame), j, errors[joint].unit)
        band = frequencies(whole, diagnosed.after[:, j], j)
        if band is not None:
            where = replace(where, summary=f"{where.summary}; {band}")
        found[joint] = Left(errors[joint].fraction, where)

    clear = max(_CAUSE * float(strength.max(initial=0.0)), 1e-9)
    for j in sorted(map(int, np.flatnonzero(strength >= clear)), key=lambda j: -strength[j]):
        if problem.joints[j] in errors and errors[problem.joints[j]].fraction > 0.0:
            add(j, np.maximum((force.force[:, j] / force.noise[j]) ** 2 - 1.0, 0.0))
    if not found:
        # No force stands out of the encoders' noise: what is left is slow, and only shows.
        for joint, error in errors.items():
            if not error.explained:
                j = problem.joints.index(joint)
                add(j, (after[:, j] / problem.floor[j]) ** 2)
    return found
