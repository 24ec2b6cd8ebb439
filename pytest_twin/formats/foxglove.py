"""Decode ``foxglove.JointStates``, in Protobuf and JSON.

https://docs.foxglove.dev/docs/sdk/schemas/joint-states: a time and a list of joints, each with a
name and optional position, velocity, acceleration and effort. A small reader of the wire format
suffices for two message types of fixed fields. https://protobuf.dev/programming-guides/encoding
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator

import numpy as np

from pytest_twin.formats import limits
from pytest_twin.formats.json_fields import object_of, time_of, values_of
from pytest_twin.formats.ros_serialization import (
    QUANTITIES,
    Batch,
    Decoded,
    Encoding,
    Integers,
    MessageError,
    check_names,
)

SCHEMA_NAME = "foxglove.JointStates"
_VARINT, _EIGHT_BYTES, _TEXT, _FOUR_BYTES = 0, 1, 2, 5
# Numbers of the fields.
_TIMESTAMP, _JOINTS = 1, 2
_NAME = 1
_QUANTITY_FIELDS = {2: "position", 3: "velocity", 5: "effort"}
_SECONDS, _NANOS = 1, 2
_SECOND_NS = 1_000_000_000
_LAST_SECOND = 2**33


class FoxgloveJointStates:
    """``foxglove.JointStates``; Protobuf where messages are serialized."""

    def serialized(
        self, data: bytes, starts: Integers, sizes: Integers, encoding: Encoding
    ) -> Iterator[Decoded]:
        """Decode many messages; consecutive ones of the same joints are one batch."""
        rows: list[int] = []
        stamps: list[int] = []
        values: list[list[list[float]]] = []
        names: tuple[str, ...] = ()
        for row, (start, size) in enumerate(zip(starts.tolist(), sizes.tolist(), strict=True)):
            try:
                stamp, joints = _message(data[start : start + size])
                check_names([name for name, _ in joints])
            except MessageError as error:
                yield row, error
                continue
            message_names = tuple(name for name, _ in joints)
            if rows and message_names != names:
                yield _batch(rows, names, stamps, values)
                rows, stamps, values = [], [], []
            names = message_names
            rows.append(row)
            stamps.append(stamp)
            values.append([quantities for _, quantities in joints])
        if rows:
            yield _batch(rows, names, stamps, values)

    def from_json(self, message: bytes, row: int) -> Batch:
        """Decode one message."""
        fields = object_of(message)
        joints = fields.get("joints")
        if not isinstance(joints, list) or not all(isinstance(one, dict) for one in joints):
            raise MessageError("joints is not a list of objects")
        if len(joints) > limits.MCAP.joints_count:
            raise MessageError(f"{len(joints)} joints, more than {limits.MCAP.joints_count}")
        names = [one.get("name") for one in joints]
        if not all(isinstance(name, str) for name in names):
            raise MessageError("joints contains a joint without a name")
        check_names(names)
        stamp, bad = time_of(fields.get("timestamp"), "timestamp")
        values = {
            quantity: values_of([one.get(quantity) for one in joints], quantity, len(names))
            for quantity in QUANTITIES
        }
        filled = {q: None if t is None or np.isnan(t).all() else t for q, t in values.items()}
        return Batch(np.array([row]), tuple(names), np.array([stamp]), bad, filled)


def _batch(
    rows: list[int], names: tuple[str, ...], stamps: list[int], values: list[list[list[float]]]
) -> Batch:
    table = np.array(values, dtype=np.float64).reshape(len(rows), len(names), len(QUANTITIES))
    filled = {
        quantity: None if np.isnan(table[:, :, k]).all() else np.ascontiguousarray(table[:, :, k])
        for k, quantity in enumerate(QUANTITIES)
    }
    return Batch(np.array(rows), names, np.array(stamps, dtype=np.int64), 0, filled)


def _message(message: bytes) -> tuple[int, list[tuple[str, list[float]]]]:
    """Return the time (ns), and name and quantities (NaN where absent) of each joint.

    Raises:
        MessageError: not a message of this type.
    """
    stamp = 0
    joints: list[tuple[str, list[float]]] = []
    for number, value in _fields(message):
        if number == _TIMESTAMP and isinstance(value, bytes):
            stamp = _time(value)
        elif number == _JOINTS and isinstance(value, bytes):
            joints.append(_joint(value))
            if len(joints) > limits.MCAP.joints_count:
                raise MessageError(f"more than {limits.MCAP.joints_count} joints")
    return stamp, joints


def _joint(message: bytes) -> tuple[str, list[float]]:
    name = ""
    values = dict.fromkeys(QUANTITIES, math.nan)
    for number, value in _fields(message):
        if number == _NAME and isinstance(value, bytes):
            try:
                name = value.decode("utf-8")
            except UnicodeDecodeError:
                raise MessageError("a joint's name is not UTF-8") from None
        elif number in _QUANTITY_FIELDS:
            if not isinstance(value, float):
                raise MessageError(f"{_QUANTITY_FIELDS[number]} is not a double")
            values[_QUANTITY_FIELDS[number]] = value
    return name, list(values.values())


def _time(message: bytes) -> int:
    seconds = nanos = 0
    for number, value in _fields(message):
        if number == _SECONDS and isinstance(value, int):
            seconds = value
        elif number == _NANOS and isinstance(value, int):
            nanos = value
    if seconds >= _LAST_SECOND or nanos >= _SECOND_NS:
        raise MessageError("timestamp is out of range")
    return seconds * _SECOND_NS + nanos


def _fields(message: bytes) -> Iterator[tuple[int, int | float | bytes]]:
    """Yield number and value of each field.

    Raises:
        MessageError: the bytes are not Protobuf.
    """
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(message, at)
            yield number, value
            continue
        if kind == _TEXT:
            size, at = _varint(message, at)
        elif kind in (_EIGHT_BYTES, _FOUR_BYTES):
            size = 8 if kind == _EIGHT_BYTES else 4
        else:
            raise MessageError(f"wire type {kind}")
        if at + size > len(message):
            raise MessageError("ends inside a field")
        content = message[at : at + size]
        at += size
        yield number, struct.unpack("<d", content)[0] if kind == _EIGHT_BYTES else content


def _varint(message: bytes, at: int) -> tuple[int, int]:
    """Return an integer and the position after it."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            raise MessageError("ends inside a number")
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise MessageError("a number is longer than 64 bits")
