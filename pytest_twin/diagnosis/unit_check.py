"""Detection of recordings in degrees or encoder counts, by comparison with the model.

If states and commands have different units, no model is needed to detect it. If both have the same
wrong unit, or commands are efforts, the model decides: its prediction agrees with the recording in
the right unit, and not in rad.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.trial_settings import UNIT_CHECK
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.errors import RecordingError, SpecError
from pytest_twin.open_loop import Replayed, replay
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial

# Smallest number of hinges that move far, by command mode. A single wheel under a servo may turn
# many times, and a model with a weak servo follows any small motion.
_FEWEST = {"position": 2, "velocity": 2, "effort": 1}
# The replay ends when a hinge has moved this part of its range, plus some s: under effort commands
# small errors grow.
_PART = {"position": 0.5, "velocity": 0.5, "effort": 0.05}
# Unit of the reading -> rad.
_UNITS = {
    "degrees": np.radians(1.0),
    **{f"counts of {n} a turn": 2.0 * np.pi / n for n in 2 ** np.arange(10, 21)},
}


def drop_other_units(realization: Realization, trials: TrialSet, notes: list[str]) -> TrialSet:
    """Trials without the recordings that are in degrees or encoder counts.

    Args:
        notes: receives a line for each recording that is left out.

    Raises:
        RecordingError: no recording remains to fit.
    """
    everything = (*trials.fit, *trials.held_out)
    far = [t for t in everything if _turns_far(t, _hinge_columns(realization, t))]
    unit = _unit_of(realization, far) if far else None
    if unit is None:
        return trials
    errors = [
        RecordingError(
            f"{'states' if t.hardest_mode == 'effort' else 'states and commands'} seem to be in "
            f"{unit}: in this unit the model follows them",
            path=t.path,
            expected="rad (m for a sliding joint); convert the recording",
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


def _hinge_columns(realization: Realization, trial: Trial) -> list[int]:
    """Columns of a trial that belong to hinges."""
    kind = realization.structure.joint_type
    return [i for i, j in enumerate(trial.joints) if kind.get(j) == "hinge"]


def _turns_far(trial: Trial, hinges: Sequence[int]) -> bool:
    travel = np.ptp(trial.position[:, hinges], axis=0)
    far = travel[travel > UNIT_CHECK.moves] > UNIT_CHECK.least_travel
    return bool(far.sum() >= _FEWEST[trial.hardest_mode] and far.all())


def _unit_of(realization: Realization, trials: Sequence[Trial]) -> str | None:
    """The unit in which the prediction agrees with the trials; None if it agrees in rad."""
    scales = (1.0, *_UNITS.values())
    angles = [_hinge_columns(realization, t) for t in trials]
    starts = [_until_first_motion(t, hinges) for t, hinges in zip(trials, angles, strict=True)]
    rows = [(t, hinges, s) for t, hinges in zip(starts, angles, strict=True) for s in scales]
    try:
        read = replay(realization, [_scale_hinges(*row) for row in rows])
    except SpecError:
        return None  # the search reports a missing controller or payload
    off = np.reshape(
        [_error(r, hinges) for r, (_, hinges, _) in zip(read, rows, strict=True)], (-1, len(scales))
    )
    in_rad, others = off[:, 0], off[:, 1:]
    least = np.median(others, axis=0)
    best = int(np.argmin(least * [UNIT_CHECK.counts_closer, *[1.0] * (len(least) - 1)]))
    closer = np.mean(others[:, best] <= UNIT_CHECK.closer * in_rad) > 0.5
    if in_rad.max() < UNIT_CHECK.fails or least[best] > UNIT_CHECK.follows or not closer:
        return None
    return list(_UNITS)[best]


def _until_first_motion(trial: Trial, hinges: Sequence[int]) -> Trial:
    """The beginning of a trial until it has moved; without a recorded velocity it starts at rest.

    A velocity from positions carries their noise, which grows under effort commands.
    """
    position = trial.position[:, hinges]
    moved = np.abs(position - position[0]) > _PART[trial.hardest_mode] * np.ptp(position, axis=0)
    until = float(trial.time[moved.any(axis=1).argmax()]) + UNIT_CHECK.seconds_on
    return trial.until(until)


def _scale_hinges(trial: Trial, hinges: Iterable[int], scale: float) -> Trial:
    """The trial with states and commands of hinges times ``scale``."""
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
    """RMS error of the hinges divided by their RMS motion; infinite if the simulation diverged."""
    measured = replayed.trial.position[:, hinges]
    error = replayed.position[:, hinges] - measured
    if not np.isfinite(error).all():
        return np.inf
    return float(np.linalg.norm(error)) / float(np.linalg.norm(measured - measured[0]))
