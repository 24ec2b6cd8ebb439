"""Differences of the simulated motion of two versions of a twin under the same commands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.errors import TwinError
from pytest_twin.formats.recording import Recording
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial, make_trials


def motion_differences(
    old: Realization, new: Realization, recordings: Sequence[Recording]
) -> tuple[dict[str, float], list[str]]:
    """Largest difference between the replays of two models, for each joint.

    Args:
        old, new: realizations with their twins.
        recordings: recordings, of which commands and first states are used.

    Returns:
        Joint -> difference, rad or m, empty if nothing can be replayed; and notes with the reasons.
    """
    found: dict[str, float] = {}
    notes: list[str] = []
    for recording in recordings:
        assert new.twin is not None
        try:
            trials = make_trials(
                recording, new.structure, new.twin.recordings, compares_motion=False
            )
            before, after = (simulate_positions(model, trials) for model in (old, new))
        except TwinError as error:
            notes.append(f"not replayed: {error}")
            continue
        for one, other in zip(before, after, strict=True):
            for joint in one.keys() & other.keys():
                difference = float(np.max(np.abs(one[joint] - other[joint])))
                found[joint] = max(found.get(joint, 0.0), difference)
    return found, notes


def simulate_positions(
    realization: Realization, trials: Sequence[Trial]
) -> list[dict[str, FloatArray]]:
    """Simulated positions of each trial: joint -> (n,) encoder readings, rad or m.

    Raises:
        SimulationError: a simulation diverged.
        TwinError: a joint, controller or payload that the model lacks.
    """
    patched = read_patched_model(realization)
    if patched is not None:
        predicted = replay_patched(realization, patched, trials)
        return [dict(zip(patched.joints, p.position.T, strict=True)) for p in predicted]
    replayed = replay(realization, trials)
    for result in replayed:
        if result.error is not None:
            raise result.error
    return [dict(zip(r.trial.joints, r.position.T, strict=True)) for r in replayed]
