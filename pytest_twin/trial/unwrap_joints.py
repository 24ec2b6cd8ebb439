"""Unwrap the recorded angles of a robot's revolute joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError
from pytest_twin.signals import Signals
from pytest_twin.trial.wrapped_angles import TURN, AmbiguousTurnsError, JointMotion, unwrap


@dataclass(frozen=True)
class RecordedMotion:
    """Positions and position commands of one topic each, in the model's names and units.

    Attributes:
        path: the recording, for errors.
        topic: topic of the positions, for errors and notes.
        joints: (j,) names.
        time: (n,) stamps of the positions, s, not decreasing.
        position: (n, j) rad or m, NaN where a message does not carry the joint.
        command_time: (m,) stamps of the commands, s, not decreasing.
        command: (m, c) commands, NaN where there is none.
        command_columns: joint -> column of its position commands; other joints have none.
    """

    path: Path
    topic: str
    joints: tuple[str, ...]
    time: FloatArray
    position: FloatArray
    command_time: FloatArray
    command: FloatArray
    command_columns: Mapping[str, int]


def unwrap_joints(motion: RecordedMotion, structure: Structure, signals: Signals) -> list[str]:
    """Unwrap positions and position commands of revolute joints in place; return notes.

    Raises:
        RecordingError: the number of turns cannot be determined.
    """
    notes = []
    for column, joint in enumerate(motion.joints):
        signal = signals.of(joint)
        wrapped = signal.position.wrapped
        if structure.joint_type.get(joint) != "hinge" or wrapped is False:
            continue
        seen = np.isfinite(motion.position[:, column])
        at = motion.command_columns.get(joint)
        sent = np.zeros(len(motion.command_time), dtype=bool)
        if at is not None:
            sent = np.isfinite(motion.command[:, at])
        joint_motion = JointMotion(
            motion.time[seen],
            motion.position[seen, column],
            motion.command_time[sent],
            motion.command[sent, at] if at is not None else motion.command_time[sent],
        )
        turn = TURN / abs(signal.gear) if signal.position.side == "motor" else TURN
        try:
            unwrapped = unwrap(joint_motion, structure.joint_range.get(joint), turn, wrapped)
        except AmbiguousTurnsError as error:
            raise RecordingError(
                "positions are recorded within one turn, and its number is not known",
                path=motion.path, where=f"{motion.topic} joint '{joint}'", value=str(error),
                expected="a recording of angles beyond a turn or at a higher rate; or in "
                f"twin.yaml signals: {{joints: {{{joint}: {{position: {{wrapped: true}}}}}}}} "
                "(the shorter way), wrapped: false (as recorded)",
            ) from None  # fmt: skip
        motion.position[seen, column] = unwrapped.position
        if at is not None:
            motion.command[sent, at] = unwrapped.command
        notes += [f"{motion.topic}: {joint}: {note}" for note in unwrapped.notes]
    return notes
