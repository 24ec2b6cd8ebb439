"""Helpers that write MCAP files with the mcap library or byte by byte."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, IndexType, Writer

SCHEMA = "sensor_msgs/msg/JointState"
START = 1_700_000_000_000_000_000


@dataclass
class Message:
    """One JointState message."""

    stamp: int
    names: tuple[str, ...] = ("shoulder", "elbow")
    position: tuple[float, ...] = ()
    velocity: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()
    frame_id: str = ""
    topic: str = "/joint_states"
    log_time: int | None = None
    raw: bytes | None = None
    extra: dict[str, Any] = field(default_factory=dict)


def cdr(message: Message, order: str = "<") -> bytes:
    """The message in CDR, encoded field by field without code of the package."""
    out = bytearray()

    def put(form: str, *values: Any) -> None:
        size = struct.calcsize(order + form[-1])
        out.extend(b"\0" * (-len(out) % size))
        out.extend(struct.pack(order + form, *values))

    def put_text(text: str) -> None:
        data = text.encode() + b"\0"
        put("I", len(data))
        out.extend(data)

    sec, nanosec = divmod(message.stamp, 1_000_000_000)
    put("i", sec)
    put("I", nanosec)
    put_text(message.frame_id)
    put("I", len(message.names))
    for name in message.names:
        put_text(name)
    for values in (message.position, message.velocity, message.effort):
        put("I", len(values))
        if values:
            put(f"{len(values)}d", *values)
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + bytes(out)


def as_json(message: Message) -> bytes:
    """The message in JSON."""
    sec, nanosec = divmod(message.stamp, 1_000_000_000)
    return json.dumps(
        {
            "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": message.frame_id},
            "name": message.names,
            "position": message.position,
            "velocity": message.velocity,
            "effort": message.effort,
            **message.extra,
        }
    ).encode()


def mcap(
    messages: Iterable[Message],
    *,
    encoding: str = "cdr",
    order: str = "<",
    schema: str | None = SCHEMA,
    metadata: Mapping[str, str] | None = None,
    **options: Any,
) -> bytes:
    """An MCAP file; ``options`` are passed to the writer of the mcap library."""
    stream = io.BytesIO()
    writer = Writer(stream, **{"compression": CompressionType.NONE, **options})
    writer.start(profile="ros2", library="test")
    if metadata is not None:
        writer.add_metadata("trial", dict(metadata))
    number = 0 if schema is None else writer.register_schema(schema, "ros2msg", b"float64 x")
    channels: dict[str, int] = {}
    for message in messages:
        if message.topic not in channels:
            channels[message.topic] = writer.register_channel(message.topic, encoding, number)
        data = message.raw
        if data is None:
            data = as_json(message) if encoding == "json" else cdr(message, order)
        log_time = message.stamp if message.log_time is None else message.log_time
        writer.add_message(channels[message.topic], log_time, data, log_time)
    writer.finish()
    return stream.getvalue()


BARE = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}
"""Options of a file without index and summary."""


def sines(count: int, topic: str = "/joint_states") -> list[Message]:
    """States at 100 Hz; all numbers differ."""
    return [
        Message(
            stamp=START + index * 10_000_000,
            position=(0.1 * index, -0.2 * index),
            velocity=(index + 0.25, index + 0.5),
            effort=(1.0 / (index + 1), 2.0 / (index + 1)),
            topic=topic,
        )
        for index in range(count)
    ]


def record(opcode: int, content: bytes) -> bytes:
    """One MCAP record."""
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str) -> bytes:
    """An MCAP string: its length and its UTF-8 bytes."""
    return struct.pack("<I", len(value.encode())) + value.encode()


def chunk(
    content: bytes, *, compression: str = "", packed: bytes | None = None, **claims: int
) -> bytes:
    """A chunk record; ``claims`` may state a wrong ``size`` or ``length``."""
    body = content if packed is None else packed
    size = claims.get("size", len(content))
    return record(
        6,
        struct.pack("<QQQI", START, START + 1, size, 0)
        + text(compression)
        + struct.pack("<Q", claims.get("length", len(body)))
        + body,
    )


def message_record(message: Message, channel: int = 1) -> bytes:
    """A message record."""
    head = struct.pack("<HIQQ", channel, 0, message.stamp, message.stamp)
    return record(5, head + cdr(message))


MAGIC = b"\x89MCAP0\r\n"
HEADER = MAGIC + record(1, text("ros2") + text("test"))
DECLARED = record(3, struct.pack("<H", 1) + text(SCHEMA) + text("ros2msg") + text("x")) + record(
    4, struct.pack("<HH", 1, 1) + text("/joint_states") + text("cdr") + text("")
)
END = record(15, b"\0\0\0\0") + record(2, b"\0" * 20) + MAGIC


def put(folder: Path, data: bytes) -> Path:
    """Write a recording."""
    path = folder / "trial.mcap"
    path.write_bytes(data)
    return path
