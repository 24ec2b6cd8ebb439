"""Predict the trials of a recording with a model, and compare with the measured states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.recording import TOPICS, JointSeries
from pytest_twin.metrics.residual import residual
from pytest_twin.trial import Trial, predicted_rows

if TYPE_CHECKING:
    from pytest_twin.diagnosis.patched.model import PatchedModel
    from pytest_twin.effects.segment import Predicted
    from pytest_twin.open_loop import Replayed
    from pytest_twin.realization import Realization


def predict(
    realization: Realization,
    patched: PatchedModel | None,
    trials: Sequence[Trial],
    progress: Callable[[float], None],
) -> tuple[list[JointSeries], tuple[str, ...]]:
    """Return the predicted joint states of each trial, and notes.

    Args:
        patched: effects of a diagnosis that are stepped together with the model, or None.
        trials: trials, of which only commands and first states are used.
        progress: called with the fraction done.

    Raises:
        SimulationError: a simulation diverged.
    """
    from pytest_twin.diagnosis.patched.replay import describe_effects_outside_mjcf, replay_patched
    from pytest_twin.open_loop import replay

    if patched is None:
        results = replay(realization, trials, progress=progress)
        for result in results:
            if result.error is not None:
                raise result.error
        notes = tuple(dict.fromkeys(note for r in results for note in r.notes))
        return [_series(t, t.joints, r) for t, r in zip(trials, results, strict=True)], notes
    predicted = replay_patched(realization, patched, trials)
    parts = [_series(t, patched.joints, p) for t, p in zip(trials, predicted, strict=True)]
    return parts, describe_effects_outside_mjcf(patched)


def _series(trial: Trial, names: tuple[str, ...], values: Replayed | Predicted) -> JointSeries:
    return JointSeries(
        topic=TOPICS["state"],
        names=names,
        stamp=trial.stamps,
        log_time=trial.stamps,
        position=values.position,
        velocity=values.velocity,
        effort=values.effort,
    )


def concatenate(parts: Sequence[JointSeries], trials: Sequence[Trial]) -> JointSeries:
    """Concatenate the predictions of all trials as one topic."""
    keep = [predicted_rows(trial) for trial in trials]

    def of(name: str) -> Any:
        return np.concatenate([getattr(p, name)[k] for p, k in zip(parts, keep, strict=True)])

    names = ("stamp", "log_time", "position", "velocity", "effort")
    return replace(parts[0], **{name: of(name) for name in names})


def predicted_positions(part: JointSeries) -> dict[str, FloatArray]:
    """Return joint -> (n,) positions, rad or m."""
    return {} if part.position is None else dict(zip(part.names, part.position.T, strict=True))


def distances(
    trials: Sequence[Trial], parts: Sequence[JointSeries], types: Mapping[str, str]
) -> dict[str, Any]:
    """Return joint -> root mean square, maximum and mean of predicted minus measured positions.

    Missing samples are ignored. Values are None for a trial with only its first state.
    """
    found = {}
    for column, joint in enumerate(parts[0].names):
        left, times = [np.zeros(0)], [np.zeros(0)]
        for trial, part in zip(trials, parts, strict=True):
            measured = trial.position[:, trial.joints.index(joint)]
            if len(measured) < 2 or part.position is None:
                continue
            seen = np.isfinite(measured)
            left.append(part.position[seen, column] - measured[seen])
            times.append(trial.offset + trial.time[seen])
        difference, time = np.concatenate(left), np.concatenate(times)
        some = len(difference) > 0
        number = residual(difference, np.zeros_like(difference))
        found[joint] = {
            "rms": number.rms if some else None,
            "max": number.maximum if some else None,
            "mean": number.mean if some else None,
            "at": float(time[number.maximum_at]) if some else None,
            "unit": "m" if types[joint] == "slide" else "rad",
        }
    return found
