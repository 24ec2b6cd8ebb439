"""Replays of one trial with changed robots: other model parameters, and forces on the joints."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.effect_parameters import EffectParameter, with_values
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.diagnosis.patched.replay import (
    patched_segment,
    predict_segments,
    replay_whole,
    with_columns,
)
from pytest_twin.errors import SimulationError
from pytest_twin.open_loop import Replayed, row_of
from pytest_twin.realization import Realization
from pytest_twin.replay_forced import replay_forced
from pytest_twin.trial import Trial

_ROWS = 16
"""Number of changed robots in one batch; it bounds the memory for their motions."""


@dataclass(frozen=True)
class Change:
    """A change of the robot.

    Attributes:
        force: (n, j) added force on the trial's joints at its stamps, in the signs of the model,
            N*m or N. It is interpolated between stamps, because held values would act half a
            period late.
        fields: field of the model -> values of all degrees of freedom, SI units.
        effects: parameters of effects beside the MJCF -> other values, SI units.
    """

    force: FloatArray
    fields: Mapping[str, FloatArray] = field(default_factory=dict)
    effects: Mapping[EffectParameter, float] = field(default_factory=dict)


class ChangedReplays:
    """Replays of one trial as ``pytest-twin replay`` makes them, and with changes of the robot.

    Effects of a fit that the MJCF cannot hold act in all of them.

    Args:
        trial: the trial, of which only commands and the first state are used.

    Attributes:
        nominal: the replay of the twin itself.

    Raises:
        RecordingError: the recording lacks a joint or a temperature that the effects need.
        SimulationError: a replay diverged, or has no position at some stamps.
    """

    def __init__(self, realization: Realization, trial: Trial) -> None:
        self._realization, self._row = realization, row_of(realization, trial)
        self._patched = read_patched_model(realization)
        if self._patched is None:
            self.nominal = self._plain(Change(np.zeros(trial.position.shape)))
        else:
            self._segment = patched_segment(realization, self._patched, trial)
            self.nominal = self._checked(replay_whole(realization, self._patched, trial))

    @property
    def model(self) -> mujoco.MjModel:
        """The model that is simulated."""
        return self._row.model if self._patched is None else self._segment.model

    def changed(self, changes: Sequence[Change]) -> list[Replayed]:
        """The replay of the robot with each change."""
        if self._patched is None:
            return [self._plain(change) for change in changes]
        batches = (changes[k : k + _ROWS] for k in range(0, len(changes), _ROWS))
        return [done for batch in batches for done in self._with_effects(batch)]

    def _plain(self, change: Change) -> Replayed:
        row = replace(self._row, model=_change_model(self._row.model, change))
        time = self._row.trial.time

        def force(now: float) -> FloatArray:
            after = int(np.searchsorted(time, now, side="right"))
            if after == 0 or after == len(time):
                return np.asarray(change.force[min(after, len(time) - 1)])
            share = (now - time[after - 1]) / (time[after] - time[after - 1])
            return np.asarray((1.0 - share) * change.force[after - 1] + share * change.force[after])

        return self._checked(replay_forced(row, lambda now, position, velocity: force(now)))

    def _with_effects(self, changes: Sequence[Change]) -> list[Replayed]:
        assert self._patched is not None
        trial = self._row.trial
        columns = [trial.joints.index(joint) for joint in self._patched.joints]
        segments = [
            replace(
                self._segment,
                model=_change_model(self._segment.model, change),
                added_force=(trial.time, change.force[:, columns]),
            )
            for change in changes
        ]
        variants = [with_values(self._patched, change.effects) for change in changes]
        predicted = predict_segments(
            self._realization, self._patched, trial, segments, variants=variants
        )
        # Joints without effects are those of the MJCF alone, as in the nominal replay.
        rest = (
            [self.nominal] * len(changes)
            if len(columns) == len(trial.joints)
            else [self._plain(change) for change in changes]
        )
        return [
            replace(
                plain,
                position=with_columns(plain.position, columns, own.position),
                velocity=with_columns(plain.velocity, columns, own.velocity),
                effort=with_columns(plain.effort, columns, own.effort),
            )
            for plain, own in zip(rest, predicted, strict=True)
        ]

    def _checked(self, done: Replayed) -> Replayed:
        if done.error is not None:
            raise done.error
        if not np.isfinite(done.position).all():
            raise SimulationError(
                "the replay has no position at some stamps",
                path=self._row.source,
                where=self._row.trial.name,
                expected="a recording whose states and commands overlap",
            )
        return done


def _change_model(model: mujoco.MjModel, change: Change) -> mujoco.MjModel:
    if not change.fields:
        return model
    changed = copy.copy(model)
    for name, values in change.fields.items():
        getattr(changed, name)[:] = values
    return changed
