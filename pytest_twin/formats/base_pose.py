"""Recorded poses of a robot's floating base: a topic of a bag, or columns of a CSV file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.errors import RecordingError
from pytest_twin.formats.ros_serialization import Floats, Integers
from pytest_twin.words import list_names

ROLE = "base"
"""Role of the topic, beside those of joint states and commands."""
COLUMNS = tuple(f"base.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))
"""Columns of a CSV file: position in the world, m, and quaternion, base to world."""
_UNIT_LENGTH = 0.02
_TRANSFORMS = ("/tf", "/tf_static")


@dataclass(frozen=True)
class BasePoses:
    """Poses of a floating base in the world, in the order of their stamps.

    Attributes:
        source: topic, or columns.
        frame: name of the frame whose pose it is; empty where none is stated.
        stamp: (n,) ns, increasing.
        position: (n, 3) m.
        quaternion: (n, 4) w x y z, base to world, of length 1.
    """

    source: str
    frame: str
    stamp: Integers
    position: Floats
    quaternion: Floats


def poses_of_topic(path: Path, topic: str) -> BasePoses:
    """Read the poses of one topic of a bag.

    Raises:
        RecordingError: the topic has no poses, or of several frames.
        TwinError: the bag cannot be read.
    """
    # The module of sensors reads bags with the readers of recordings, whose package uses this one.
    from pytest_twin.formats.sensor_bag import SensorCollector, gather_sensors

    bag = gather_sensors(SensorCollector(path, {}))
    poses = bag.poses.get(topic, [])
    frames = {one.child for one in poses}
    if not poses or len(frames) > 1:
        known = sorted(name for name in bag.poses if name not in _TRANSFORMS)
        raise RecordingError(
            "poses of several frames" if poses else "no poses of the base",
            path=path, where=topic, value=list_names(sorted(frames)) if poses else None,
            expected="a topic of nav_msgs/Odometry, geometry_msgs/PoseStamped, "
            "PoseWithCovarianceStamped or TransformStamped with one frame"
            + (f": --topics {ROLE}={' or '.join(known)}" if known else ""),
        )  # fmt: skip
    values = np.array([one.values for one in poses])
    stamp = np.array([one.stamp for one in poses], dtype=np.int64)
    return _in_order(topic, frames.pop(), stamp, values[:, :3], values[:, [6, 3, 4, 5]])


def poses_of_columns(
    path: Path, stamp: Integers, columns: Mapping[str, Floats]
) -> BasePoses | None:
    """Return the poses in columns of a CSV file; None if it has none of them.

    Args:
        path: the file, for errors.
        stamp: (n,) ns of each row.
        columns: heading -> (n,) values, NaN where a cell is empty.

    Raises:
        RecordingError: a column is missing, or a quaternion has not the length 1.
    """
    if not columns:
        return None
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        raise RecordingError(
            "columns of the base's pose are missing", path=path, value=list_names(missing),
            expected=", ".join(COLUMNS) + " (m, and a quaternion base to world)",
        )  # fmt: skip
    values = np.column_stack([columns[name] for name in COLUMNS])
    filled = np.isfinite(values).all(axis=1)
    values, stamp = values[filled], stamp[filled]
    length = np.linalg.norm(values[:, 3:], axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > _UNIT_LENGTH)
    if wrong.size or not len(values):
        raise RecordingError(
            "no quaternion of the base" if wrong.size else "no pose of the base", path=path,
            where="base.qw base.qx base.qy base.qz",
            value=f"length {length[wrong[0]]:.4g}" if wrong.size else None,
            expected="a quaternion of length 1, w first",
        )  # fmt: skip
    return _in_order("base.x to base.qz", "", stamp, values[:, :3], values[:, 3:])


def _in_order(
    source: str, frame: str, stamp: Integers, position: Floats, quaternion: Floats
) -> BasePoses:
    _, rows = np.unique(stamp, return_index=True)
    unit = quaternion[rows] / np.linalg.norm(quaternion[rows], axis=1, keepdims=True)
    # q and -q are the same orientation: neighbours get the same sign.
    flips = np.cumprod(np.append(1.0, np.where((unit[1:] * unit[:-1]).sum(axis=1) < 0, -1.0, 1.0)))
    return BasePoses(source, frame, stamp[rows], position[rows], unit * flips[:, None])
