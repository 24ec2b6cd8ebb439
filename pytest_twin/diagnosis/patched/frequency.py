"""Frequency responses of recordings beside those that a fitted model predicts for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import patched_of
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.errors import TwinError
from pytest_twin.metrics.joint_frequency import joint_responses
from pytest_twin.realization import Realization
from pytest_twin.replay import replay
from pytest_twin.trial import Trial


def frequency_responses(realization: Realization, trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Every joint's responses in the recording that supports the most frequencies, in Hz, dB, rad.

    Args:
        realization: the fitted model, loaded from its folder.
        trials: recordings, of which the measured motion and the prediction are compared.
    """
    return best_responses(trials, lambda at: _predicted(realization, trials[at]))


def best_responses(
    trials: Sequence[Trial], predicted: Callable[[int], Mapping[str, FloatArray]]
) -> list[dict[str, Any]]:
    """Every joint's responses in the recording that supports the most frequencies, in Hz, dB, rad.

    Args:
        trials: with measured motion.
        predicted: number of a trial -> joint -> (n,) predicted positions.
    """
    chosen: dict[tuple[str, str], tuple[int, int]] = {}
    for at, trial in enumerate(trials):
        for joint in trial.joints:
            for one in joint_responses(trial, joint):
                lines = len(one.measured.frequency)
                if lines > chosen.get((joint, one.input), (0, 0))[0]:
                    chosen[joint, one.input] = lines, at
    known = {at: predicted(at) for at in {at for _, at in chosen.values()}}
    return [
        one.to_json()
        for (joint, given), (_, at) in chosen.items()
        for one in joint_responses(trials[at], joint, known[at].get(joint))
        if one.input == given
    ]


def _predicted(realization: Realization, trial: Trial) -> dict[str, FloatArray]:
    """Joint -> (n,) predicted positions; empty where the simulation diverges."""
    patched = patched_of(realization)
    try:
        if patched is None:
            result = replay(realization, [trial], tcp=False)[0]
            if result.error is not None:
                return {}
            return dict(zip(trial.joints, result.position.T, strict=True))
        found = replay_patched(realization, patched, [trial])[0]
    except TwinError:
        return {}
    return dict(zip(patched.joints, found.position.T, strict=True))
