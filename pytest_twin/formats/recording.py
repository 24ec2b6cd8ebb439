"""What a recording is once it is read, whatever file it came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pytest_twin.formats.serialized import Floats, Integers

_NOTES = 40

TOPICS: Mapping[str, str] = {"state": "/joint_states", "command": "/joint_commands"}
"""Role -> topic, where neither ``twin.yaml`` nor ``--topics`` says otherwise."""


@dataclass(frozen=True)
class JointSeries:
    """All JointState messages of one topic, in the order of the file.

    Attributes:
        topic: the topic.
        names: joints, in the order in which messages first name them.
        stamp: (n,) ns, ``header.stamp``: the clock of whoever sent the message. Where no message
            has one it is ``log_time``, and the recording's damage says so.
        log_time: (n,) ns, the recorder's clock.
        position: (n, j) rad or m. None where every message left it empty, NaN where a message
            left it empty or does not name the joint.
        velocity: (n, j) rad/s or m/s, likewise.
        effort: (n, j) N*m or N, likewise.
        stamped: whether any message has a ``header.stamp`` of its own.
    """

    topic: str
    names: tuple[str, ...]
    stamp: Integers
    log_time: Integers
    position: Floats | None
    velocity: Floats | None
    effort: Floats | None
    stamped: bool = True


@dataclass(frozen=True)
class Topic:
    """One topic of a recording, read or not.

    Attributes:
        name: the topic.
        type: its message type, ``sensor_msgs/msg/JointState``; empty where none is stated.
        messages: how many.
        roles: what it can serve as: ``state``, ``command``, both or none.
        joints: of its first message that can be decoded; empty for other types.
        filled: the quantities that this message fills.
    """

    name: str
    type: str
    messages: int
    roles: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    filled: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recording:
    """What one recording holds of a robot's motion.

    Attributes:
        path: the file or folder.
        series: role (``state``, ``command``) -> its messages; roles without messages are left out.
        metadata: what the recording says of itself (the metadata record ``trial`` of an MCAP
            file): role, payload, ...; empty where it says nothing.
        damage: what is wrong with the file or the times; empty for a sound one.
        notes: how the file was read where it leaves something open, one line each.
        topics: all topics of the file, whatever their type; empty for a format without topics.
    """

    path: Path
    series: Mapping[str, JointSeries]
    metadata: Mapping[str, str]
    damage: tuple[Damage, ...]
    notes: tuple[str, ...] = ()
    topics: tuple[Topic, ...] = ()


@dataclass(frozen=True)
class Damage:
    """Something that is wrong with a recording, so that what was read is not all that was sent.

    Attributes:
        place: where: a byte offset in the file, a chunk, a topic's message.
        lost: what is missing or doubtful.
    """

    place: str
    lost: str

    def __str__(self) -> str:
        return f"{self.place}: {self.lost}"


class Notes:
    """Damage as it is found; a bounded list, the rest is counted."""

    def __init__(self) -> None:
        self._found: list[Damage] = []
        self._more = 0

    def add(self, place: str, lost: str) -> None:
        """Note one damage."""
        if len(self._found) < _NOTES:
            self._found.append(Damage(place, lost))
        else:
            self._more += 1

    def all(self) -> tuple[Damage, ...]:
        """All notes; the last says how many were left out."""
        if not self._more:
            return tuple(self._found)
        return (*self._found, Damage("further on", f"{self._more} more places like these"))
