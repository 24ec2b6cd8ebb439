"""Simulate a base model with a guarded residual under the commands of a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.adaptation.guard import Guard, Sample
from pytest_twin.arrays import FloatArray
from pytest_twin.open_loop import Replayed, Row
from pytest_twin.realization.encoders import Encoders
from pytest_twin.replay_forced import replay_forced

Distort = Callable[[float, Sample, Guard], Sample | None]
"""Function from time (s), sample and guard to the disturbed sample."""


@dataclass(slots=True)
class Log:
    """Log of a residual during a simulation.

    Attributes:
        time: time of each evaluation, s.
        force: (j,) force of each evaluation, N*m or N.
    """

    time: list[float] = field(default_factory=list)
    force: list[FloatArray] = field(default_factory=list)

    @property
    def table(self) -> tuple[FloatArray, FloatArray]:
        """(n,) times, s, and (n, j) forces, N*m or N."""
        return np.array(self.time), np.array(self.force)


def simulate(
    row: Row,
    guard: Guard,
    *,
    distort: Distort | None = None,
    kick: tuple[float, FloatArray] | None = None,
) -> tuple[Replayed, Log]:
    """Replay a trial with a residual that gets the simulated state as sensor samples.

    The residual does not get the measured state; otherwise it could pull the prediction towards the
    measurement.

    Args:
        row: trial with the base model.
        guard: guard of the residual; it is reset first.
        distort: fault of the sensors, applied to each sample, or None.
        kick: impact on the residual's joints, in the form of
            :func:`pytest_twin.replay_forced.replay_forced`.
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
    """Return the newest command of each joint, in model coordinates; its position without one."""
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
