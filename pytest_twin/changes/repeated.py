"""Motions of earlier recordings that were repeated: the difference of the recordings themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis
from pytest_twin.trial import Trial
from pytest_twin.trial.repeated import is_repeated


@dataclass(frozen=True, slots=True)
class RepeatedMotion:
    """A new recording that repeats the commands of earlier ones.

    Attributes:
        before: the earlier recordings.
        difference: joint -> RMS of new minus mean earlier position, rad or m.
        remains: joint -> RMS of this difference minus the predicted one, rad or m; empty if nothing
            changed.
    """

    new: Trial
    before: tuple[Trial, ...]
    difference: Mapping[str, float]
    remains: Mapping[str, float]


def repeated_motions(
    before: Sequence[Trial],
    new: Sequence[Trial],
    changes: PreparedProblem | None = None,
    hypothesis: Hypothesis = EMPTY,
) -> tuple[RepeatedMotion, ...]:
    """Each new recording that repeats a motion, with its difference to the earlier recordings.

    Args:
        changes: problem of the changes, from whose measured positions the residual of the earlier
            recordings is subtracted; None if nothing changed.
        hypothesis: the changes.
    """
    out = []
    for trial in new:
        same = tuple(other for other in before if is_repeated(trial, other))
        if same:
            remains = {} if changes is None else _remains(changes, hypothesis, trial)
            out.append(RepeatedMotion(trial, same, _difference(trial, same), remains))
    return tuple(out)


def _difference(trial: Trial, same: Sequence[Trial]) -> dict[str, float]:
    joints = [j for j in trial.joints if all(j in other.joints for other in same)]
    out = {}
    for joint in joints:
        each = [_position(other, joint, trial.time) for other in same]
        change = trial.position[:, trial.joints.index(joint)] - np.mean(each, axis=0)
        out[joint] = float(np.sqrt(np.nanmean(change**2)))
    return out


def _position(trial: Trial, joint: str, time: FloatArray) -> FloatArray:
    return np.interp(time, trial.time, trial.position[:, trial.joints.index(joint)])


def _remains(changes: PreparedProblem, hypothesis: Hypothesis, trial: Trial) -> dict[str, float]:
    """RMS of the difference that the changes leave; empty where it was not compared directly."""
    problem = changes.problem
    own = [
        s
        for s, segment in enumerate(problem.simulator.segments)
        if segment.mode == "position" and np.array_equal(segment.time[-1:], trial.time[-1:])
    ]
    if changes.window is not None or len(own) != 1:
        return {}
    (errors,) = problem.at(hypothesis).errors([hypothesis], np.array(own))
    rms = np.sqrt(np.mean(errors[:, : len(problem.joints)] ** 2, axis=0))
    return dict(zip(problem.joints, map(float, rms), strict=True))
