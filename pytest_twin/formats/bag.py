"""Data classes for the content of a bag file: schemas, channels, and blocks of messages."""

from __future__ import annotations

from dataclasses import dataclass, field

from pytest_twin.formats.recording import Notes
from pytest_twin.formats.ros_serialization import Integers


@dataclass(frozen=True)
class Schema:
    """Message type of a channel."""

    name: str
    encoding: str


@dataclass(frozen=True)
class Channel:
    """One topic and the encoding of its messages."""

    schema_id: int
    topic: str
    encoding: str


@dataclass(frozen=True)
class Region:
    """Messages that share one block of bytes.

    Attributes:
        place: position of the block in the file, for messages to people.
        channel, log_time, start, size: (n,) per message; ``log_time`` in ns, ``start`` and
            ``size`` of its payload in ``data`` in bytes.
    """

    data: bytes
    place: str
    channel: Integers
    log_time: Integers
    start: Integers
    size: Integers


@dataclass
class Contents:
    """Everything in one bag file except the messages.

    Attributes:
        notes: lost or damaged parts.
        schemas, channels: number in the file -> declaration.
        metadata: name and fields of each metadata record.
        message_counts: channel -> number of messages.
        has_checksum: whether a checksum covers the whole data section, metadata records included.
    """

    notes: Notes = field(default_factory=Notes)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    message_counts: dict[int, int] = field(default_factory=dict)
    has_checksum: bool = False
