"""Helpers that write poses, wrenches and IMU readings to MCAP with the library ``rosbags``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
POSE, WRENCH, IMU = (
    "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/WrenchStamped", "sensor_msgs/msg/Imu",
)  # fmt: skip
ODOMETRY, STATES = "nav_msgs/msg/Odometry", "sensor_msgs/msg/JointState"


def _made(name: str, *values: Any) -> Any:
    return STORE.types[name](*values)


def message(kind: str, stamp: int, values: Sequence[float], frame: str = "sensor") -> Any:
    """A ROS message: pose (xyz, qx qy qz qw), wrench (6) or IMU (angular rate, acceleration).

    Of odometry ``frame`` is the child's; joint states are of j0, j1, ...
    """
    numbers = [float(value) for value in values]
    time = _made("builtin_interfaces/msg/Time", *divmod(stamp, 1_000_000_000))
    header = _made("std_msgs/msg/Header", time, frame)

    def vector(three: Sequence[float]) -> Any:
        return _made("geometry_msgs/msg/Vector3", *three)

    if kind in (POSE, ODOMETRY):
        point = _made("geometry_msgs/msg/Point", *numbers[:3])
        turn = _made("geometry_msgs/msg/Quaternion", *numbers[3:])
        pose = _made("geometry_msgs/msg/Pose", point, turn)
        if kind == POSE:
            return _made(kind, header, pose)
        unknown = np.zeros(36)
        twist = _made("geometry_msgs/msg/Twist", vector(np.zeros(3)), vector(np.zeros(3)))
        return _made(
            kind, header, frame, _made("geometry_msgs/msg/PoseWithCovariance", pose, unknown),
            _made("geometry_msgs/msg/TwistWithCovariance", twist, unknown),
        )  # fmt: skip
    if kind == STATES:
        names = [f"j{at}" for at in range(len(numbers))]
        return _made(kind, header, names, np.array(numbers), np.zeros(0), np.zeros(0))
    if kind == WRENCH:
        wrench = _made("geometry_msgs/msg/Wrench", vector(numbers[:3]), vector(numbers[3:]))
        return _made(kind, header, wrench)
    still = _made("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    none = np.zeros(9)
    return _made(kind, header, still, none, vector(numbers[:3]), none, vector(numbers[3:]), none)


def _plain(found: Any) -> Any:
    if hasattr(found, "__dataclass_fields__"):
        fields = [name for name in found.__dataclass_fields__ if not name.startswith("__")]
        return {name: _plain(getattr(found, name)) for name in fields}
    return found.tolist() if isinstance(found, np.ndarray) else found


def write(
    path: Path,
    topics: Mapping[str, tuple[str, Sequence[int], np.ndarray]],
    encoding: str = "cdr",
    metadata: Mapping[str, str] | None = None,
    frame: str = "sensor",
) -> Path:
    """Write an MCAP file; ``topics``: topic -> message type, stamps (ns) and (n, k) values."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, (kind, stamps, rows) in topics.items():
            schema = writer.register_schema(kind, "ros2msg", b"")
            channel = writer.register_channel(topic, encoding, schema)
            for stamp, row in zip(stamps, rows, strict=True):
                made = message(kind, int(stamp), row, frame)
                data = (
                    bytes(STORE.serialize_cdr(made, kind))
                    if encoding == "cdr"
                    else json.dumps(_plain(made)).encode()
                )
                writer.add_message(channel, int(stamp), data, int(stamp))
        if metadata:
            writer.add_metadata("trial", dict(metadata))
        writer.finish()
    return path
