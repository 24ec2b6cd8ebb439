"""Angles in degrees or counts that nothing in a recording gives away: the model tells.

States in another unit than their commands show it by themselves. Where both are in the same wrong
one, or commands are efforts, a model that is any good follows the recording once it is read in the
right one, and not before.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.errors import RecordingError, SpecError
from pytest_twin.realization import Realization
from pytest_twin.replay import Replayed, replay
from pytest_twin.trial import Trial

# A recording of which every hinge that moves turns further, rad, is asked.
_FAR = 2.0 * np.pi
_MOVES = 1e-6
# So many hinges at least: one wheel under a servo turns on and on, and a model that is too weak for
# it follows whatever is small.
_FEWEST = {"position": 2, "velocity": 2, "effort": 1}
# Replayed until a hinge has gone this part of its way, and s on: under effort commands small errors
# grow.
_PART, _ON = {"position": 0.5, "velocity": 0.5, "effort": 0.05}, 0.3
# Error beside the motion that the reading as it came leaves somewhere (what is slow a servo follows
# in any unit), that another one leaves in most recordings at most, and how much less that is.
_FAILS, _FOLLOWS, _CLOSER = 0.5, 0.3, 0.25
# Degrees are what people write: counts have to be that much closer.
_COUNTS_CLOSER = 0.5
# What is read -> rad.
_UNITS = {
    "degrees": np.radians(1.0),
    **{f"counts of {n} a turn": 2.0 * np.pi / n for n in 2 ** np.arange(10, 21)},
}


def without_other_units(realization: Realization, trials: TrialSet, notes: list[str]) -> TrialSet:
    """Leave out recordings that the model follows once they are read in another unit.

    Args:
        realization: the model as it came.
        trials: what was recorded.
        notes: gets what was left out.

    Raises:
        RecordingError: all that could be fitted are in another unit.
    """
    everything = (*trials.fit, *trials.held_out)
    far = [t for t in everything if _turns_far(t, _hinges(realization, t))]
    unit = _unit_of(realization, far) if far else None
    if unit is None:
        return trials
    errors = [
        RecordingError(
            f"{'states' if t.hardest_mode == 'effort' else 'states and commands'} as if in {unit}: "
            "read so, the model follows them",
            path=t.path,
            expected="rad (m where a joint slides)",
        )
        for t in far
    ]
    others = {t.path for t in far}
    fit, aside = (
        tuple(t for t in role if t.path not in others) for role in (trials.fit, trials.held_out)
    )
    if not fit:
        raise errors[0]
    notes += [f"left out: {error}" for error in errors]
    return replace(trials, fit=fit, held_out=aside)


def _hinges(realization: Realization, trial: Trial) -> list[int]:
    """Columns of a trial that are angles."""
    kind = realization.structure.joint_type
    return [i for i, j in enumerate(trial.joints) if kind.get(j) == "hinge"]


def _turns_far(trial: Trial, hinges: Sequence[int]) -> bool:
    travel = np.ptp(trial.position[:, hinges], axis=0)
    far = travel[travel > _MOVES] > _FAR
    return bool(far.sum() >= _FEWEST[trial.hardest_mode] and far.all())


def _unit_of(realization: Realization, trials: Sequence[Trial]) -> str | None:
    """The unit in which the model follows trials and does not as they came; None where there is
    none.
    """
    scales = (1.0, *_UNITS.values())
    angles = [_hinges(realization, t) for t in trials]
    starts = [_beginning(t, hinges) for t, hinges in zip(trials, angles, strict=True)]
    rows = [(t, hinges, s) for t, hinges in zip(starts, angles, strict=True) for s in scales]
    try:
        read = replay(realization, [_scaled(*row) for row in rows], tcp=False)
    except SpecError:
        return None  # what the model lacks is said where it is needed
    off = np.reshape(
        [_error(r, hinges) for r, (_, hinges, _) in zip(read, rows, strict=True)], (-1, len(scales))
    )
    came, others = off[:, 0], off[:, 1:]
    least = np.median(others, axis=0)
    best = int(np.argmin(least * [_COUNTS_CLOSER, *[1.0] * (len(least) - 1)]))
    closer = np.mean(others[:, best] <= _CLOSER * came) > 0.5
    if came.max() < _FAILS or least[best] > _FOLLOWS or not closer:
        return None
    return list(_UNITS)[best]


def _beginning(trial: Trial, hinges: Sequence[int]) -> Trial:
    """Until it has moved; it starts as its recording does, at rest where that has no velocity: one
    that is told from positions carries their noise, which under effort commands grows.
    """
    position = trial.position[:, hinges]
    gone = np.abs(position - position[0]) > _PART[trial.hardest_mode] * np.ptp(position, axis=0)
    until = float(trial.time[gone.any(axis=1).argmax()]) + _ON
    n = int(np.searchsorted(trial.time, until, side="right"))
    return replace(
        trial,
        time=trial.time[:n],
        position=trial.position[:n],
        velocity=None if trial.velocity is None else trial.velocity[:n],
        effort=None if trial.effort is None else trial.effort[:n],
    )


def _scaled(trial: Trial, hinges: Iterable[int], scale: float) -> Trial:
    """The same with the angles of hinges in another unit, and what commands them."""
    names = {trial.joints[i] for i in hinges}

    def of(joints: Iterable[str], values: FloatArray) -> FloatArray:
        scaled: FloatArray = values * [scale if j in names else 1.0 for j in joints]
        return scaled

    commanded = zip(trial.command_joints, trial.command_modes, strict=True)
    by_angle = [scale if j in names and mode != "effort" else 1.0 for j, mode in commanded]
    return replace(
        trial,
        position=of(trial.joints, trial.position),
        velocity=None if trial.velocity is None else of(trial.joints, trial.velocity),
        command=trial.command * by_angle,
    )


def _error(replayed: Replayed, hinges: Sequence[int]) -> float:
    """Root mean square of what is left beside that of the motion, over hinges; infinite where the
    model diverged.
    """
    measured = replayed.trial.position[:, hinges]
    left = replayed.position[:, hinges] - measured
    if not np.isfinite(left).all():
        return np.inf
    return float(np.linalg.norm(left)) / float(np.linalg.norm(measured - measured[0]))
