"""Decode ROS messages of poses, transforms and images, one by one, from CDR.

Layouts: geometry_msgs, tf2_msgs and sensor_msgs of ROS 2 common_interfaces. The layouts of ROS 1
differ only by a sequence number in the header, which ``Cursor`` skips.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.ros_serialization import Cursor, Encoding, MessageError

_ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    _ODOMETRY,
)
"""Types whose messages begin with a header and a pose; the rest of a message is not read."""
TRANSFORMS = ("tf2_msgs/msg/TFMessage",)
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")

MOST_TRANSFORMS = 10_000
"""Largest number of transforms in a message."""
_CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4,
             "mono16": 1, "16UC1": 1}  # fmt: skip
_LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in a grey value (ITU-R BT.601)."""


@dataclass(frozen=True)
class StampedMessage:
    """A pose with its stamp.

    Attributes:
        stamp: ns.
        parent, child: names of the frames; ``child`` is empty where the message names none.
        values: (7,) x y z [m] and quaternion qx qy qz qw, child to parent.
    """

    stamp: int
    parent: str
    child: str
    values: FloatArray


@dataclass(frozen=True)
class Picture:
    """An image of a camera.

    Attributes:
        stamp: ns.
        grey: (height, width) grey values, or None if the message contains a compressed file.
        file: bytes of a JPEG or PNG file, empty if the message contains pixels.
    """

    stamp: int
    grey: np.ndarray | None
    file: bytes = b""


def poses_of(message: bytes, kind: str, encoding: Encoding) -> list[StampedMessage]:
    """Return the poses in one message of a type in ``POSES`` or ``TRANSFORMS``.

    Raises:
        MessageError: not a message of this type.
    """
    cursor = Cursor(message, encoding)
    if kind in TRANSFORMS:
        count = cursor.count("transforms")
        if count > MOST_TRANSFORMS:
            raise MessageError(f"{count} transforms, more than {MOST_TRANSFORMS}")
        return [_stamped_message(cursor, named=True) for _ in range(count)]
    return [_stamped_message(cursor, named=kind.endswith("TransformStamped") or kind == _ODOMETRY)]


def picture_of(message: bytes, kind: str, encoding: Encoding) -> Picture:
    """Return the image in one message of a type in ``IMAGES``.

    Raises:
        MessageError: not a message of this type, or an unsupported pixel format.
    """
    cursor = Cursor(message, encoding)
    stamp, _ = _header(cursor)
    if kind.endswith("CompressedImage"):
        cursor.text("format")
        return Picture(stamp, None, _bytes(cursor))
    height, width = cursor.integers("II", "height and width")
    name = cursor.text("encoding")
    big = cursor.message[cursor.skip(1, "is_bigendian", 1)]
    (step,) = cursor.integers("I", "step")
    data = _bytes(cursor)
    if name not in _CHANNELS:
        raise MessageError(f"pixel format {name!r} is not one of {', '.join(_CHANNELS)}")
    depth = 2 if "16" in name else 1
    row = width * _CHANNELS[name] * depth
    if step < row or len(data) < step * height or not (height and width):
        raise MessageError(f"{len(data)} bytes for {height} rows of {step}")
    table = np.frombuffer(data, np.uint8, step * height).reshape(height, step)[:, :row]
    if depth == 2:
        wide = np.ascontiguousarray(table).view(">u2" if big else "<u2").astype(np.float64)
        return Picture(stamp, np.round(wide * 255.0 / max(wide.max(), 1.0)).astype(np.uint8))
    if _CHANNELS[name] == 1:
        return Picture(stamp, np.ascontiguousarray(table))
    colours = table.reshape(height, width, -1)[:, :, :3]
    if not name.startswith("rgb"):
        colours = colours[:, :, ::-1]
    return Picture(stamp, np.round(colours @ _LUMA).astype(np.uint8))


def stamp_of(message: bytes, encoding: Encoding) -> int:
    """Return ``header.stamp`` of a message that begins with a header, ns."""
    return _header(Cursor(message, encoding))[0]


def _header(cursor: Cursor) -> tuple[int, str]:
    if not cursor.cdr:
        cursor.skip(4, "header.seq")
    second, nanosecond = cursor.integers("iI", "header.stamp")
    return second * 1_000_000_000 + nanosecond, cursor.text("header.frame_id")


def _stamped_message(cursor: Cursor, *, named: bool) -> StampedMessage:
    stamp, parent = _header(cursor)
    child = cursor.text("child_frame_id") if named else ""
    first = cursor.skip(56, "a pose", 8)
    values = np.array(struct.unpack_from(cursor.order + "7d", cursor.message, first))
    if not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1.0) > 0.02:
        raise MessageError("a pose without a quaternion of length 1")
    return StampedMessage(stamp, parent.lstrip("/"), child.lstrip("/"), values)


def _bytes(cursor: Cursor) -> bytes:
    count = cursor.count("data")
    first = cursor.skip(count, "data", 1)
    return cursor.message[first : first + count]
