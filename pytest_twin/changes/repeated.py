"""Motions of earlier recordings that were repeated: the difference of the recordings themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import f

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.search_result import SearchResult
from pytest_twin.estimation.score import effective_samples
from pytest_twin.trial import Trial
from pytest_twin.trial.repeated import is_repeated

_DAY = 10
"""Number of characters of a date without its time: 2026-05-03."""


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
    changes: SearchResult | None = None,
) -> tuple[RepeatedMotion, ...]:
    """Each new recording that repeats a motion, with its difference to the earlier recordings.

    Args:
        changes: result of the search for changes, from whose measured positions the residual of
            the earlier recordings is subtracted; None if nothing changed.
    """
    out = []
    for trial in new:
        same = tuple(other for other in before if is_repeated(trial, other))
        if same:
            remains = {} if changes is None else _remains(changes, trial)
            out.append(RepeatedMotion(trial, same, _difference(trial, same), remains))
    return tuple(out)


@dataclass(frozen=True, slots=True)
class RepeatedAlarm:
    """The difference of a repeated motion that is least likely where nothing changed.

    Attributes:
        probability: of a difference as large as this of any joint in any of the repeated motions.
    """

    new: Trial
    joint: str
    probability: float


def is_alarm(least: RepeatedAlarm | None, level: float) -> bool:
    """Whether a difference is an alarm at a level, such as 0.05."""
    return least is not None and least.probability < level


def least_likely(motions: Sequence[RepeatedMotion], earlier: SearchResult) -> RepeatedAlarm | None:
    """Compare differences of repeated motions with the errors of earlier recordings (F test).

    The part of an error that differs from one repetition to the next is at most the whole error of
    the model in that motion. Where the motion was repeated on another day, it is the scatter of
    these repetitions; those of one day share their conditions. Samples are counted by their
    correlation, and tests by Bonferroni's inequality.

    Args:
        motions: the repeated motions.
        earlier: the model of the earlier recordings, with these.

    Returns:
        None without a repeated motion, and where the model was compared in windows: their errors
        are those of a part of a motion.
    """
    problem, trials = earlier.prepared.problem, earlier.trials.fit
    if not motions or earlier.prepared.window is not None:
        return None
    best = earlier.explanation.hypothesis
    (errors,) = problem.at(best).errors([best], problem.fit)
    owner = np.repeat(
        [earlier.prepared.segment_trial[s] for s in problem.fit], problem.lengths(problem.fit)
    )
    count = sum(len(motion.difference) for motion in motions)
    tested = []
    for motion in motions:
        for joint in motion.difference:
            if joint not in problem.joints:
                continue
            change = _change(motion.new, motion.before, joint)
            column = problem.joints.index(joint)
            if len({other.metadata.get("date", "")[:_DAY] for other in motion.before}) > 1:
                each = np.array([_position(o, joint, motion.new.time) for o in motion.before])
                parts = list(each - each.mean(axis=0))
                lost = 1.0 - 1.0 / len(parts)
            else:
                same = {_key(other) for other in motion.before}
                parts = [errors[owner == k, column] for k, t in enumerate(trials)
                         if _key(t) in same]  # fmt: skip
                lost = 1.0
            if not parts:
                continue
            variance = float(np.mean(np.concatenate(parts) ** 2)) / lost
            variance = max(variance, float(problem.floor[column]) ** 2)
            ratio = np.mean(change**2) / (variance * (1.0 + 1.0 / len(motion.before)))
            freedom = [_independent(change), lost * sum(map(_independent, parts))]
            chance = min(count * float(f.sf(ratio, *np.maximum(freedom, 1.0))), 1.0)
            tested.append(RepeatedAlarm(motion.new, joint, chance))
    return min(tested, key=lambda each: each.probability, default=None)


def _key(trial: Trial) -> tuple[Path, float]:
    """A trial by its recording and its part of it; preparation makes new objects of it."""
    return trial.path, trial.offset


def _independent(series: FloatArray) -> float:
    """Number of independent samples of a series."""
    return float(effective_samples(series[:, None], [len(series)])[0])


def _change(trial: Trial, same: Sequence[Trial], joint: str) -> FloatArray:
    """(samples,) new minus mean earlier position of a joint, rad or m."""
    mean = np.mean([_position(other, joint, trial.time) for other in same], axis=0)
    change: FloatArray = trial.position[:, trial.joints.index(joint)] - mean
    return change


def _difference(trial: Trial, same: Sequence[Trial]) -> dict[str, float]:
    joints = [j for j in trial.joints if all(j in other.joints for other in same)]
    return {j: float(np.sqrt(np.nanmean(_change(trial, same, j) ** 2))) for j in joints}


def _position(trial: Trial, joint: str, time: FloatArray) -> FloatArray:
    return np.interp(time, trial.time, trial.position[:, trial.joints.index(joint)])


def _remains(changes: SearchResult, trial: Trial) -> dict[str, float]:
    """RMS of the difference that the changes leave; empty where it was not compared directly."""
    problem, prepared = changes.prepared.problem, changes.prepared
    hypothesis, fitted = changes.explanation.hypothesis, changes.trials.fit
    own = [
        s
        for s, k in enumerate(prepared.segment_trial)
        if k < len(fitted) and _key(fitted[k]) == _key(trial)
    ]
    segments = problem.simulator.segments
    if prepared.window is not None or len(own) != 1 or segments[own[0]].mode != "position":
        return {}
    (errors,) = problem.at(hypothesis).errors([hypothesis], np.array(own))
    rms = np.sqrt(np.mean(errors[:, : len(problem.joints)] ** 2, axis=0))
    return dict(zip(problem.joints, map(float, rms), strict=True))
