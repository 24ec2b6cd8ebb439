"""A bag: messages of several topics, as the files of a recorder hold them."""

from __future__ import annotations

from dataclasses import dataclass, field

from pytest_twin.formats.recording import Notes
from pytest_twin.formats.serialized import Integers


@dataclass(frozen=True)
class Schema:
    """What a channel's messages are."""

    name: str
    encoding: str


@dataclass(frozen=True)
class Channel:
    """A topic and how its messages are encoded."""

    schema_id: int
    topic: str
    encoding: str


@dataclass(frozen=True)
class Region:
    """Messages that lie in one piece of memory.

    Attributes:
        data: the bytes.
        place: where the piece is in the file.
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
    """What one file of a bag declares and holds beside the messages.

    Attributes:
        notes: what is lost or damaged.
        schemas, channels: by number.
        metadata: name and fields of each metadata record.
        message_counts: channel -> messages.
        has_checksum: whether a checksum covers the whole data section, metadata records included.
    """

    notes: Notes = field(default_factory=Notes)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    message_counts: dict[int, int] = field(default_factory=dict)
    has_checksum: bool = False
