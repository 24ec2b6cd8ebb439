"""Measured loss of an export: its errors on held-out recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.export.integration import Integration
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial

Errors = Mapping[str, float]
"""Joint -> RMS error over all recordings, rad or m."""
TOLERANCE = 0.05
"""Increase of a joint's error up to which an effect counts as kept, relative."""
MOST_SECONDS = 120.0
"""Largest total length of the recordings that are simulated, s."""


def chosen_trials(trials: Sequence[Trial], most_seconds: float = MOST_SECONDS) -> tuple[Trial, ...]:
    """The first trials up to a total length in s, at least one."""
    chosen: list[Trial] = []
    for trial in trials:
        if chosen and sum(t.duration for t in chosen) + trial.duration > most_seconds:
            break
        chosen.append(trial)
    return tuple(chosen)


def patched_errors(
    realization: Realization, patched: PatchedModel | None, trials: Sequence[Trial]
) -> Errors:
    """Errors of the diagnosed model as pytest-twin steps it.

    Raises:
        TwinError: a simulation diverged, or a recording lacks a joint.
    """
    if patched is None:
        predicted = [dict(zip(r.trial.joints, r.position.T, strict=True))
                     for r in replay(realization, trials)]  # fmt: skip
    else:
        predicted = [
            dict(zip(patched.joints, p.position.T, strict=True))
            for p in replay_patched(realization, patched, trials)
        ]
    return errors_of(trials, predicted)


def without(patched: PatchedModel, effect: str, joint: str | None) -> PatchedModel:
    """The effects without those of one kind and joint that pytest-twin applies itself."""
    return replace(
        patched,
        effects=tuple(
            e for e in patched.effects if e.is_in_mjcf or (e.effect, e.joint) != (effect, joint)
        ),
    )


def errors_of(trials: Sequence[Trial], predicted: Sequence[Mapping[str, FloatArray]]) -> Errors:
    """RMS difference of measured and predicted positions; infinite where a prediction diverged."""
    squares: dict[str, list[FloatArray]] = {}
    for trial, positions in zip(trials, predicted, strict=True):
        for joint, position in positions.items():
            measured = trial.position[:, trial.joints.index(joint)]
            known = np.isfinite(measured)
            squares.setdefault(joint, []).append((position - measured)[known] ** 2)
    errors = {}
    for joint, parts in squares.items():
        mean = float(np.mean(np.concatenate(parts)))
        errors[joint] = float(np.sqrt(mean)) if np.isfinite(mean) else float("inf")
    return errors


def increase(errors: Errors, reference: Errors) -> dict[str, float]:
    """Joint -> relative increase of its error, for the joints of both."""
    return {
        joint: errors[joint] / max(reference[joint], 1e-12) - 1.0
        for joint in reference
        if joint in errors
    }


def first_within(
    candidates: Sequence[Integration],
    measure: Callable[[Integration], Errors],
    reference: Errors,
) -> tuple[Integration, Errors, Errors]:
    """The first integration within :data:`TOLERANCE` of the reference, else the best.

    Returns:
        The integration, its errors, and those of the first candidate.
    """
    measured: list[Errors] = []
    worst: list[float] = []
    for candidate in candidates:
        measured.append(measure(candidate))
        worst.append(max(increase(measured[-1], reference).values(), default=0.0))
        if worst[-1] <= TOLERANCE:
            break
    best = int(np.argmin(worst))
    return candidates[best], measured[best], measured[0]
