"""Messages and bags of a robot, written with third-party libraries."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from mcap_ros2.writer import Writer
from scipy.spatial.transform import Rotation

LINE = 80 * "="
HEADER = (
    LINE
    + """
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
)
POSE = (
    LINE
    + """
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
)
TRANSFORM = """std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
"""
TRANSFORM_PARTS = (
    LINE
    + """
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
)
TYPES = {
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
    "float64[] velocity\nfloat64[] effort\n" + HEADER,
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n"
    + HEADER
    + POSE,
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"
    "================================================================================\n"
    "MSG: geometry_msgs/TransformStamped\n" + TRANSFORM + HEADER + TRANSFORM_PARTS,
    "sensor_msgs/msg/Image": "std_msgs/Header header\nuint32 height\nuint32 width\n"
    "string encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n" + HEADER,
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n"
    + HEADER,
}


def header(seconds: float, frame: str = "") -> dict:
    nanoseconds = round(1e9 * (1.7e9 + seconds))
    stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
    return {"stamp": stamp, "frame_id": frame}


def place(pose: np.ndarray, position: str, orientation: str) -> dict:
    x, y, z = pose[:3, 3].tolist()
    a, b, c, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return {position: {"x": x, "y": y, "z": z}, orientation: {"x": a, "y": b, "z": c, "w": w}}


def joint_state(seconds: float, names: list[str], values: np.ndarray) -> dict:
    return {
        "header": header(seconds), "name": names, "position": values.tolist(), "velocity": [],
        "effort": [],
    }  # fmt: skip


def pose_stamped(seconds: float, pose: np.ndarray) -> dict:
    return {"header": header(seconds, "camera"), "pose": place(pose, "position", "orientation")}


def transforms(seconds: float, *named: tuple[str, str, np.ndarray]) -> dict:
    return {
        "transforms": [
            {
                "header": header(seconds, parent),
                "child_frame_id": child,
                "transform": place(pose, "translation", "rotation"),
            }
            for parent, child, pose in named
        ]
    }


def image(seconds: float, grey: np.ndarray, encoding: str = "mono8") -> dict:
    pixels = grey if encoding == "mono8" else np.repeat(grey[:, :, None], 3, axis=2)
    height, width = grey.shape
    return {
        "header": header(seconds), "height": height, "width": width, "encoding": encoding,
        "is_bigendian": 0, "step": width * (1 if encoding == "mono8" else 3),
        "data": pixels.tobytes(),
    }  # fmt: skip


def compressed(seconds: float, grey: np.ndarray) -> dict:
    data = cv2.imencode(".png", grey)[1].tobytes()
    return {"header": header(seconds), "format": "png", "data": data}


def write(
    path: Path, messages: list[tuple[str, str, float, dict]], metadata: dict | None = None
) -> None:
    """Write messages, given as (topic, type, time in s, message), in order of time."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        schemas = {kind: writer.register_msgdef(kind, TYPES[kind]) for _, kind, _, _ in messages}
        for topic, kind, seconds, message in sorted(messages, key=lambda one: one[2]):
            nanoseconds = round(1e9 * (1.7e9 + seconds))
            writer.write_message(topic, schemas[kind], message, nanoseconds, nanoseconds)
        if metadata:
            writer._writer.add_metadata("trial", metadata)
        writer.finish()
