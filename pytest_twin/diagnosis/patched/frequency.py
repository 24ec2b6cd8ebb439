"""Compare frequency responses of recordings with those of a fitted model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.errors import TwinError
from pytest_twin.metrics.joint_frequency import joint_responses
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial


def frequency_responses(realization: Realization, trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Return each joint's responses in the recording with the most frequencies, Hz, dB, rad.

    Args:
        realization: fitted model, loaded from its folder.
        trials: recordings with measured motion.
    """
    return best_responses(trials, lambda at: _predict_positions(realization, trials[at]))


def best_responses(
    trials: Sequence[Trial], predicted: Callable[[int], Mapping[str, FloatArray]]
) -> list[dict[str, Any]]:
    """Every joint's responses in the recording that supports the most frequencies, in Hz, dB, rad.

    Args:
        trials: trials with measured motion.
        predicted: function from the index of a trial to joint -> (n,) predicted positions, rad or
            m.
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


def _predict_positions(realization: Realization, trial: Trial) -> dict[str, FloatArray]:
    """Return joint -> (n,) predicted positions, rad or m; empty if the simulation diverges."""
    patched = read_patched_model(realization)
    try:
        if patched is None:
            result = replay(realization, [trial])[0]
            if result.error is not None:
                return {}
            return dict(zip(trial.joints, result.position.T, strict=True))
        found = replay_patched(realization, patched, [trial])[0]
    except TwinError:
        return {}
    return dict(zip(patched.joints, found.position.T, strict=True))
