"""Data classes for a recording after it is read, the same for every file format."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.formats.base_pose import BasePoses
from pytest_twin.formats.ros_serialization import Floats, Integers

DEGREE = math.pi / 180.0
"""rad."""
_NOTES = 40
"""Largest number of notes on a recording."""

TOPICS: Mapping[str, str] = {"state": "/joint_states", "command": "/joint_commands"}
"""Role -> default topic; ``twin.yaml`` and ``--topics`` override it."""


@dataclass(frozen=True)
class JointSeries:
    """Joint values of one topic over time, in the order of the file.

    Attributes:
        names: joints, in the order in which messages first name them.
        stamp: (n,) ``header.stamp``, ns, on the sender's clock. If no message has a stamp it
            equals ``log_time``, and the recording's damage has a note.
        log_time: (n,) time on the recorder's clock, ns.
        position: (n, j) rad or m. None where every message left it empty, NaN where a message
            left it empty or does not name the joint.
        velocity: (n, j) rad/s or m/s, None and NaN as for ``position``.
        effort: (n, j) N*m or N, None and NaN as for ``position``.
        stamped: whether any message has a ``header.stamp`` of its own.
        from_trajectories: whether these are setpoints of trajectories, so that velocities are
            slopes of the positions.
        degrees: (j,) joints whose positions and velocities were degrees, because an option or the
            format said so of all joints; they are rad now. Empty if there is none.
        stated: joints whose unit the recording itself states; no option changes it.
    """

    topic: str
    names: tuple[str, ...]
    stamp: Integers
    log_time: Integers
    position: Floats | None
    velocity: Floats | None
    effort: Floats | None
    stamped: bool = True
    from_trajectories: bool = False
    degrees: tuple[bool, ...] = ()
    stated: frozenset[str] = frozenset()

    def from_degrees(self) -> JointSeries:
        """The series with positions and velocities in rad, if the recorded ones are degrees."""
        degrees = tuple(name not in self.stated for name in self.names)
        scale = np.where(degrees, DEGREE, 1.0)
        return replace(
            self,
            position=None if self.position is None else self.position * scale,
            velocity=None if self.velocity is None else self.velocity * scale,
            degrees=degrees,
        )

    def has_any_quantity(self, column: int) -> bool:
        """Whether the fields of a joint have the same values, as where none is stated."""
        if self.position is None or self.velocity is None or self.effort is None:
            return False
        scale = DEGREE if self.degrees and self.degrees[column] else 1.0
        position, velocity = self.position[:, column], self.velocity[:, column]
        effort = self.effort[:, column] * scale
        return bool(
            np.array_equal(position, velocity, equal_nan=True)
            and np.array_equal(position, effort, equal_nan=True)
        )


@dataclass(frozen=True)
class Topic:
    """One topic of a recording, whether it was read or not.

    Attributes:
        type: message type, such as ``sensor_msgs/msg/JointState``; empty if none is stated.
        messages: number of messages.
        roles: roles that it can have: ``state``, ``command``, both or none.
        joints: joints of its first message that can be decoded; empty for types without joints.
        filled: quantities that this message contains.
    """

    name: str
    type: str
    messages: int
    roles: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    filled: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recording:
    """Joint states and commands of one recording.

    Attributes:
        path: the file or folder.
        series: role (``state``, ``command``) -> its messages; roles without messages are left out.
        metadata: the trial's metadata (the metadata record ``trial`` of an MCAP file), such as
            role or payload; empty if there is none.
        damage: defects of the file or of the times; empty for an undamaged file.
        notes: assumptions about what the file does not state, one line each.
        topics: all topics of the file, whatever their type; empty for a format without topics.
        base: poses of the robot's floating base, where the recording has them.
    """

    path: Path
    series: Mapping[str, JointSeries]
    metadata: Mapping[str, str]
    damage: tuple[Damage, ...]
    notes: tuple[str, ...] = ()
    topics: tuple[Topic, ...] = ()
    base: BasePoses | None = None


@dataclass(frozen=True)
class Damage:
    """One defect of a recording, such as lost messages or doubtful times.

    Attributes:
        place: a byte offset in the file, a chunk, or a message of a topic.
        lost: the missing or doubtful data.
    """

    place: str
    lost: str

    def __str__(self) -> str:
        return f"{self.place}: {self.lost}"


class Notes:
    """Collects damage in a list of limited length, and counts the rest."""

    def __init__(self) -> None:
        self._found: list[Damage] = []
        self._more = 0

    def add(self, place: str, lost: str) -> None:
        """Add one defect."""
        if len(self._found) < _NOTES:
            self._found.append(Damage(place, lost))
        else:
            self._more += 1

    def all(self) -> tuple[Damage, ...]:
        """Return all defects; the last one has the number of omitted ones."""
        if not self._more:
            return tuple(self._found)
        return (*self._found, Damage("further on", f"{self._more} more places like these"))
