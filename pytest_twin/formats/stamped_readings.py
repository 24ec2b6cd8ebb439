"""Decode wrenches and inertial measurements from CDR or JSON, and poses from JSON.

Layouts: ``geometry_msgs/WrenchStamped``, ``sensor_msgs/Imu`` and ``geometry_msgs/PoseStamped`` of
ROS 2 common_interfaces; the layouts of ROS 1 differ only by a sequence number in the header.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.json_fields import object_of, stamp_of
from pytest_twin.formats.ros_serialization import Cursor, Encoding, MessageError
from pytest_twin.formats.sensor_messages import StampedMessage

WRENCH, IMU = "geometry_msgs/msg/WrenchStamped", "sensor_msgs/msg/Imu"
READINGS = (WRENCH, IMU)
_AXES = ("x", "y", "z")
_COVARIANCE_BYTES = 9 * 8
"""Length of a (3, 3) covariance in double precision."""


@dataclass(frozen=True)
class Reading:
    """One measurement of a sensor.

    Attributes:
        stamp: ns.
        frame: ``header.frame_id``.
        values: (6,) force (N) and torque (N*m) of a wrench; angular velocity (rad/s) and linear
            acceleration (m/s^2) of an IMU, both in the sensor's axes.
    """

    stamp: int
    frame: str
    values: FloatArray


def reading_of(message: bytes, kind: str, encoding: Encoding) -> Reading:
    """Return the measurement in one serialized message of a type in ``READINGS``.

    Raises:
        MessageError: not a message of this type, or a value that is not finite.
    """
    cursor = Cursor(message, encoding)
    if not cursor.cdr:
        cursor.skip(4, "header.seq")
    second, nanosecond = cursor.integers("iI", "header.stamp")
    frame = cursor.text("header.frame_id")
    if kind == WRENCH:
        values = _doubles(cursor, 6, "wrench")
    else:
        cursor.skip(4 * 8 + _COVARIANCE_BYTES, "orientation", 8)
        turning = _doubles(cursor, 3, "angular_velocity")
        cursor.skip(_COVARIANCE_BYTES, "angular_velocity_covariance", 8)
        values = np.concatenate([turning, _doubles(cursor, 3, "linear_acceleration")])
        cursor.skip(_COVARIANCE_BYTES, "linear_acceleration_covariance", 8)
    cursor.end()
    return Reading(second * 1_000_000_000 + nanosecond, frame, _finite(values))


def reading_of_json(message: bytes, kind: str) -> Reading:
    """Return the measurement in one JSON message with the fields of a type in ``READINGS``.

    Raises:
        MessageError: the message is not JSON, or lacks these fields.
    """
    found = object_of(message)
    if kind == WRENCH:
        wrench = _part(found, "wrench")
        values = [*_numbers(wrench, "force", _AXES), *_numbers(wrench, "torque", _AXES)]
    else:
        values = [
            *_numbers(found, "angular_velocity", _AXES),
            *_numbers(found, "linear_acceleration", _AXES),
        ]
    header = found.get("header")
    return Reading(stamp_of(header)[0], _frame(header), _finite(np.array(values)))


def pose_of_json(message: bytes) -> StampedMessage:
    """Return the pose in one JSON message with the fields of a ``PoseStamped``.

    Raises:
        MessageError: not JSON, missing fields, or a quaternion that is not of length 1.
    """
    found = object_of(message)
    pose = _part(found, "pose")
    values = [
        *_numbers(pose, "position", _AXES),
        *_numbers(pose, "orientation", (*_AXES, "w")),
    ]
    checked = _finite(np.array(values))
    if abs(np.linalg.norm(checked[3:]) - 1.0) > 0.02:
        raise MessageError("a pose without a quaternion of length 1")
    header = found.get("header")
    return StampedMessage(stamp_of(header)[0], _frame(header), "", checked)


def _doubles(cursor: Cursor, count: int, what: str) -> FloatArray:
    first = cursor.skip(8 * count, what, 8)
    return np.array(struct.unpack_from(f"{cursor.order}{count}d", cursor.message, first))


def _finite(values: FloatArray) -> FloatArray:
    if not np.isfinite(values).all():
        raise MessageError("a value that is not finite")
    return values


def _part(found: dict[str, object], field: str) -> dict[str, object]:
    part = found.get(field)
    if not isinstance(part, dict):
        raise MessageError(f"{field} is not an object")
    return part


def _numbers(found: dict[str, object], field: str, names: Sequence[str]) -> list[float]:
    part = _part(found, field)
    values = [part.get(name) for name in names]
    if not all(type(value) in (int, float) for value in values):
        raise MessageError(f"{field} contains a value that is not a number")
    try:
        return [float(value) for value in values]  # type: ignore[arg-type]
    except OverflowError:
        raise MessageError(f"{field} contains a number out of range") from None


def _frame(header: object) -> str:
    frame = header.get("frame_id") if isinstance(header, dict) else None
    return frame if isinstance(frame, str) else ""
