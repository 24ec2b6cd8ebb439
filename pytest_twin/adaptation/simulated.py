"""A base model with a guarded residual beside it, simulated under a recording's commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.adaptation.guard import Guard, Sample
from pytest_twin.arrays import FloatArray
from pytest_twin.realization.encoders import Encoders
from pytest_twin.replay import Replayed, Row
from pytest_twin.replay_forced import replay_forced

Distort = Callable[[float, Sample, Guard], Sample | None]
"""What a fault makes of a sample at a time (s)."""


@dataclass(slots=True)
class Log:
    """What a residual did during a simulation.

    Attributes:
        time: of each evaluation, s.
        force: (j,) of each.
    """

    time: list[float] = field(default_factory=list)
    force: list[FloatArray] = field(default_factory=list)

    @property
    def table(self) -> tuple[FloatArray, FloatArray]:
        """(n,) times and (n, j) forces."""
        return np.array(self.time), np.array(self.force)


def simulate(
    row: Row,
    guard: Guard,
    *,
    distort: Distort | None = None,
    kick: tuple[float, FloatArray] | None = None,
) -> tuple[Replayed, Log]:
    """Replay a trial with a residual, whose sensors see the simulated state.

    The residual never sees what was measured: it could otherwise pull the prediction there.

    Args:
        row: the trial, with the base model.
        guard: of the residual; started anew.
        distort: what its sensors do to each sample; nothing if None.
        kick: an impact, as :func:`pytest_twin.replay_forced.replay_forced` takes it, for the
            residual's joints.
    """
    trial, joints = row.trial, list(guard.spec.joints)
    columns = [trial.joints.index(joint) for joint in joints]
    held = np.zeros(len(trial.joints))
    log, period = Log(), guard.spec.period
    guard.restart()
    commands = _commands(row, joints)
    due = 0.0

    def force(time: float, position: FloatArray, velocity: FloatArray) -> FloatArray:
        nonlocal due
        if time >= due - 1e-9:
            due += period
            seen: Sample | None = Sample(
                time, position[columns], velocity[columns], commands(time, position[columns])
            )
            if distort is not None and seen is not None:
                seen = distort(time, seen, guard)
            held[columns] = guard.force(time, seen)
            log.time.append(time)
            log.force.append(held[columns].copy())
        return held

    whole = None
    if kick is not None:
        whole = (kick[0], np.zeros(len(trial.joints)))
        whole[1][columns] = kick[1]
    return replay_forced(row, force, kick=whole), log


def _commands(row: Row, joints: list[str]) -> Callable[[float, FloatArray], FloatArray]:
    """The newest command of each joint, in the model's terms; its position where it has none."""
    trial = row.trial
    encoders = Encoders.of(row.calibration, trial.command_joints)
    table = encoders.model_command(trial.command, trial.command_modes)
    columns = [
        trial.command_joints.index(joint) if joint in trial.command_joints else -1
        for joint in joints
    ]
    commanded = np.array(columns) >= 0

    def at(time: float, position: FloatArray) -> FloatArray:
        row_of = max(int(np.searchsorted(trial.command_time, time, side="right")) - 1, 0)
        found: FloatArray = np.where(commanded, table[row_of, columns], position)
        return found

    return at
