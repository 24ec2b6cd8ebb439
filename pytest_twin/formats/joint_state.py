"""``sensor_msgs/msg/JointState``: decoded from bytes and JSON, encoded as CDR."""

from __future__ import annotations

import struct

import numpy as np

from pytest_twin.formats.json_fields import names_of, object_of, stamp_of, values_of
from pytest_twin.formats.ros_serialization import QUANTITIES, Batch, Cursor, Layout

SCHEMA_NAME = "sensor_msgs/msg/JointState"
SCHEMA_TEXT = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def layout_of(cursor: Cursor) -> Layout:
    """Return the byte positions of the fields of one serialized message.

    Raises:
        MessageError: the message is not a JointState.
    """
    stamp_at = cursor.header()
    names = cursor.names()
    values_at = {quantity: cursor.doubles(quantity) for quantity in QUANTITIES}
    cursor.end()
    return cursor.layout(names, stamp_at, values_at)


def decode_json(message: bytes, row: int) -> Batch:
    """Decode one JSON message with the fields of a JointState.

    Raises:
        MessageError: the message is not JSON, or lacks these fields.
    """
    found = object_of(message)
    names = names_of(found.get("name"))
    stamp, bad = stamp_of(found.get("header"))
    values = {name: values_of(found.get(name), name, len(names)) for name in QUANTITIES}
    return Batch(np.array([row]), tuple(names), np.array([stamp]), bad, values)


def encode_cdr(
    names: tuple[str, ...],
    stamp: int,
    values: dict[str, list[float] | None],
    name_bytes: dict[tuple[str, ...], bytes],
) -> bytes:
    """Encode one JointState as little-endian CDR with an empty ``frame_id``.

    Args:
        stamp: ``header.stamp`` in ns.
        values: quantity -> one value per joint (SI units), or None for an empty sequence.
        name_bytes: cache of encoded names, which this function fills.
    """
    fixed = name_bytes.get(names)
    if fixed is None:
        out = bytearray(b"\x01\0\0\0\0\0\0\0") + struct.pack("<I", len(names))
        for name in names:
            text = name.encode("utf-8") + b"\0"
            out += bytes(-len(out) % 4) + struct.pack("<I", len(text)) + text
        fixed = name_bytes[names] = bytes(out)
    sec, nanosec = divmod(stamp, 1_000_000_000)
    message = bytearray(struct.pack("<4siI", b"\0\1\0\0", sec, nanosec) + fixed)
    for name in QUANTITIES:
        series = values[name]
        message += bytes(-len(message) % 4)
        message += struct.pack("<I", 0 if series is None else len(series))
        if series is not None:
            message += bytes((4 - len(message)) % 8) + struct.pack(f"<{len(series)}d", *series)
    return bytes(message)
