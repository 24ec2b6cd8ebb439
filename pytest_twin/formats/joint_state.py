"""``sensor_msgs/msg/JointState`` on the wire: CDR many at a time, JSON one at a time.

CDR: OMG "Data Distribution Service Interoperability Wire Protocol" 2.5, section 10 (XCDR1), which
ROS 2 writes: four bytes of encapsulation, then fields aligned to their size from there on.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.formats import limits

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
QUANTITIES = ("position", "velocity", "effort")

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# After this many layouts of one size the messages that are left are decoded one by one.
_LAYOUTS_PER_GROUP = 16


class MessageError(ValueError):
    """A message that is no JointState; the words say why."""


@dataclass(frozen=True)
class Batch:
    """Messages of one layout.

    Attributes:
        rows: (n,) which messages of those that were given.
        names: joints, as the messages order them.
        stamp: (n,) ``header.stamp`` in ns.
        bad_stamp: how many stamps have ``nanosec`` of a second or more.
        values: quantity -> (n, j), or None where these messages leave it empty.
    """

    rows: Integers
    names: tuple[str, ...]
    stamp: Integers
    bad_stamp: int
    values: dict[str, Floats | None]


@dataclass(frozen=True)
class _Layout:
    """Where the fields of a CDR message lie, and the bytes that say so."""

    names: tuple[str, ...]
    fields: np.dtype[Any]
    present: tuple[str, ...]
    structure: tuple[tuple[int, int], ...]


def decode_cdr(
    data: bytes, starts: Integers, sizes: Integers
) -> Iterator[Batch | tuple[int, MessageError]]:
    """Decode CDR messages that lie in ``data``, all of one layout at a time.

    Args:
        data: a chunk's content.
        starts: (n,) where each message begins.
        sizes: (n,) its length in bytes.

    Yields:
        a batch, or the row of a message that cannot be decoded and why.
    """
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        yield from _decode_group(data, starts, rows, int(size))


def _decode_group(
    data: bytes, starts: Integers, rows: Integers, size: int
) -> Iterator[Batch | tuple[int, MessageError]]:
    if size == 0:
        for row in rows:
            yield int(row), MessageError("empty message")
        return
    # Overlapping windows, one per byte: taking rows of it copies whole messages.
    windows = np.ndarray((len(data) - size + 1,), dtype=f"V{size}", buffer=data, strides=(1,))
    for _ in range(_LAYOUTS_PER_GROUP):
        if not rows.size:
            return
        start = int(starts[rows[0]])
        try:
            layout = _layout(data[start : start + size])
        except MessageError as error:
            yield int(rows[0]), error
            rows = rows[1:]
            continue
        messages = windows[starts[rows]]
        same = _same_layout(messages, layout, size)
        yield _batch(rows[same], messages[same], layout)
        rows = rows[~same]
    for row, start in zip(rows.tolist(), starts[rows].tolist(), strict=True):
        try:
            layout = _layout(data[start : start + size])
        except MessageError as error:
            yield row, error
        else:
            yield _batch(np.array([row]), windows[[start]], layout)


def _same_layout(messages: NDArray[np.void], layout: _Layout, size: int) -> NDArray[np.bool_]:
    table = messages.view(np.uint8).reshape(len(messages), size)
    same = np.ones(len(messages), dtype=bool)
    for first, last in layout.structure:
        same &= (table[:, first:last] == table[0, first:last]).all(axis=1)
    return same


def _batch(rows: Integers, messages: NDArray[np.void], layout: _Layout) -> Batch:
    fields = messages.view(layout.fields)
    nanosec = fields["nanosec"].astype(np.int64)
    stamp = fields["sec"].astype(np.int64) * 1_000_000_000 + nanosec
    values: dict[str, Floats | None] = {
        name: fields[name].astype(np.float64) if name in layout.present else None
        for name in QUANTITIES
    }
    bad_stamp = int((nanosec >= 1_000_000_000).sum())
    return Batch(rows, layout.names, stamp, bad_stamp, values)


def _layout(message: bytes) -> _Layout:
    if len(message) < 4:
        raise MessageError("shorter than its encapsulation")
    if message[:2] not in (b"\x00\x00", b"\x00\x01"):
        raise MessageError(f"encapsulation 0x{message[:2].hex()} is not plain CDR")
    order = "<" if message[1] == 1 else ">"
    count = struct.Struct(order + "I")

    def length(at: int, what: str) -> tuple[int, int]:
        at += -at % 4
        if at + 4 > len(message):
            raise MessageError(f"ends inside {what}")
        return int(count.unpack_from(message, at)[0]), at + 4

    frame_size, at = length(12, "header.frame_id")
    if at + frame_size > len(message):
        raise MessageError("header.frame_id is longer than the message")
    structure = [(0, 2), (12, 16)]
    first = at + frame_size
    first += -first % 4
    joints, at = length(first, "name")
    if joints > limits.MCAP.joints_count:
        raise MessageError(f"{joints} joints, more than {limits.MCAP.joints_count}")
    names = []
    for _ in range(joints):
        size, at = length(at, "name")
        if at + size > len(message):
            raise MessageError("a joint's name is longer than the message")
        try:
            names.append(message[at : at + size].removesuffix(b"\0").decode("utf-8"))
        except UnicodeDecodeError:
            raise MessageError("a joint's name is not UTF-8") from None
        at += size
    formats: list[tuple[str, Any, int]] = [("sec", order + "i4", 4), ("nanosec", order + "u4", 8)]
    present = []
    for name in QUANTITIES:
        values, at = length(at, name)
        structure.append((first, at))
        if values:
            if values != joints:
                raise MessageError(f"{values} values of {name} for {joints} joints")
            # From the encapsulation's end; an empty sequence has no padding after its count.
            at += (4 - at) % 8
            if at + 8 * values > len(message):
                raise MessageError(f"ends inside {name}")
            formats.append((name, (order + "f8", (values,)), at))
            present.append(name)
            at += 8 * values
        first = at
    if len(message) - at > 7:
        raise MessageError(f"{len(message) - at} bytes left over")
    _check_names(names)
    fields = np.dtype(
        {
            "names": [name for name, _, _ in formats],
            "formats": [form for _, form, _ in formats],
            "offsets": [offset for _, _, offset in formats],
            "itemsize": len(message),
        }
    )
    return _Layout(tuple(names), fields, tuple(present), tuple(structure))


def _check_names(names: list[str]) -> None:
    if not names:
        raise MessageError("no joint names")
    if len(set(names)) != len(names):
        raise MessageError("a joint stands twice")
    if not all(name and name.isprintable() for name in names):
        raise MessageError("a joint's name is empty or unprintable")


def decode_json(message: bytes, row: int) -> Batch:
    """Decode one JSON message with the fields of a JointState.

    ``header.stamp`` is ``{"sec": ..., "nanosec": ...}`` (``nsec`` too); ``null`` among values is
    what JSON writers make of NaN.

    Raises:
        MessageError: no JSON, or not these fields.
    """
    try:
        found = json.loads(message)
    except (ValueError, RecursionError) as error:
        raise MessageError(f"not JSON: {str(error)[:80]}") from None
    if not isinstance(found, dict):
        raise MessageError("not a JSON object")
    names = found.get("name")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise MessageError("name is no list of text")
    if len(names) > limits.MCAP.joints_count:
        raise MessageError(f"{len(names)} joints, more than {limits.MCAP.joints_count}")
    _check_names(names)
    stamp, bad = _json_stamp(found.get("header"))
    values = {name: _json_values(found.get(name), name, len(names)) for name in QUANTITIES}
    return Batch(np.array([row]), tuple(names), np.array([stamp]), bad, values)


def _json_stamp(header: object) -> tuple[int, int]:
    stamp = header.get("stamp") if isinstance(header, dict) else None
    if stamp is None:
        return 0, 0
    if not isinstance(stamp, dict):
        raise MessageError("header.stamp is no object")
    sec, nanosec = stamp.get("sec"), stamp.get("nanosec", stamp.get("nsec"))
    for name, value, low, high in (("sec", sec, -(2**31), 2**31), ("nanosec", nanosec, 0, 2**32)):
        if type(value) is not int or not low <= value < high:
            raise MessageError(f"header.stamp.{name} is no whole number in range")
    assert isinstance(sec, int)
    assert isinstance(nanosec, int)
    return sec * 1_000_000_000 + nanosec, int(nanosec >= 1_000_000_000)


def _json_values(found: object, name: str, joints: int) -> Floats | None:
    if found is None or found == []:
        return None
    if not isinstance(found, list):
        raise MessageError(f"{name} is no list")
    if len(found) != joints:
        raise MessageError(f"{len(found)} values of {name} for {joints} joints")
    if not all(value is None or type(value) in (int, float) for value in found):
        raise MessageError(f"{name} holds what is no number")
    try:
        return np.array([[math.nan if v is None else float(v) for v in found]], dtype=np.float64)
    except OverflowError:
        raise MessageError(f"{name} holds a number out of range") from None


def encode_cdr(
    names: tuple[str, ...],
    stamp: int,
    values: dict[str, list[float] | None],
    name_bytes: dict[tuple[str, ...], bytes],
) -> bytes:
    """One JointState as little-endian CDR with an empty ``frame_id``.

    Args:
        names: joints.
        stamp: ``header.stamp`` in ns.
        values: quantity -> one value per joint, or None for an empty sequence.
        name_bytes: cache of encoded names, filled here.
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
