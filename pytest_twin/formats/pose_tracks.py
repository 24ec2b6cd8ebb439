"""Read the motion of a free object from an archive of tosses or from a bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pytest_twin.errors import RecordingError
from pytest_twin.formats import tosses
from pytest_twin.formats.pose_track import PoseTrack, WrenchTrack
from pytest_twin.formats.sensor_bag import SensorCollector, gather_sensors
from pytest_twin.formats.stamped_readings import WRENCH

_TRANSFORMS = ("/tf", "/tf_static")


def holds_tosses(path: Path) -> bool:
    """Whether a path is an archive of tosses, judged by its suffix."""
    return path.suffix.lower() == tosses.SUFFIX


def read_pose_tracks(
    path: Path, topic: str | None = None, wrench: str | None = None
) -> list[PoseTrack]:
    """Return the tosses of an archive, or the poses of one topic of a bag as one track.

    Args:
        path: an ``.npz`` file, an MCAP file, a rosbag2 folder or a ``.db3`` file.
        topic: topic of the poses, needed if a bag has several.
        wrench: topic of the external force and torque, if the object was pushed.

    Raises:
        RecordingError: no poses, no wrenches, or several topics to choose from.
        TwinError: the file cannot be read.
    """
    if holds_tosses(path):
        return tosses.read_tosses(path)
    bag = gather_sensors(SensorCollector(path, {}))
    topics = sorted(name for name in bag.poses if name not in _TRANSFORMS)
    if topic is None and len(topics) == 1:
        topic = topics[0]
    if topic is None or len(bag.poses.get(topic, ())) < 2:
        raise RecordingError(
            "no poses" if topic or not topics else "several topics of poses",
            path=path,
            value=topic or ", ".join(topics) or None,
            expected="one topic of geometry_msgs/PoseStamped, or --pose-topic",
        )
    poses = bag.poses[topic]
    stamps = np.array([one.stamp for one in poses], dtype=np.int64)
    _, rows = np.unique(stamps, return_index=True)
    values = np.array([poses[row].values for row in rows])
    return [
        PoseTrack(
            topic,
            path,
            (stamps[rows] - stamps[rows[0]]) * 1e-9,
            values[:, :3],
            values[:, [6, 3, 4, 5]] / np.linalg.norm(values[:, 3:], axis=1, keepdims=True),
            metadata=tuple(sorted(bag.metadata.items())),
            wrench=None if wrench is None else _wrenches(bag, wrench, int(stamps[rows[0]])),
        )
    ]


def _wrenches(bag: SensorCollector, topic: str, zero: int) -> WrenchTrack:
    readings = bag.readings.get(topic, ())
    frames = {one.frame for one in readings}
    if len(readings) < 2 or bag.reading_type[topic] != WRENCH or len(frames) > 1:
        raise RecordingError(
            "several frames of wrenches" if len(frames) > 1 else "no wrenches",
            path=bag.path, where=topic, value=", ".join(sorted(frames)) or None,
            expected="a topic of geometry_msgs/WrenchStamped in one frame",
        )  # fmt: skip
    stamps = np.array([one.stamp for one in readings], dtype=np.int64)
    _, rows = np.unique(stamps, return_index=True)
    values = np.array([readings[row].values for row in rows])
    seconds = np.asarray((stamps[rows] - zero) * 1e-9, dtype=np.float64)
    return WrenchTrack(frames.pop(), seconds, values)
