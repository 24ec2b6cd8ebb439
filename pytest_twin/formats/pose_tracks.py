"""Motions of a free object from any recording that has them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pytest_twin.errors import RecordingError
from pytest_twin.formats import tosses
from pytest_twin.formats.pose_track import PoseTrack
from pytest_twin.formats.recordings import reader_of
from pytest_twin.formats.recordings.base import BagReader
from pytest_twin.formats.sensor_bag import SensorGatherer, gather_sensors

_TRANSFORMS = ("/tf", "/tf_static")


def holds_tosses(path: Path) -> bool:
    """Whether a path is an archive of tosses, by its name."""
    return path.suffix.lower() == tosses.SUFFIX


def is_bag(path: Path) -> bool:
    """Whether a path is a recording of messages, which may hold poses.

    Raises:
        TwinError: no recording that can be read.
    """
    return isinstance(reader_of(path), BagReader)


def read_pose_tracks(path: Path, topic: str | None = None) -> list[PoseTrack]:
    """The tosses of an archive, or the poses of one topic of a bag as one track.

    Args:
        path: an ``.npz`` file, an MCAP file, a rosbag2 folder or a ``.db3`` file.
        topic: of the poses, where a bag has several.

    Raises:
        RecordingError: no poses, or several topics that could be meant.
        TwinError: as the reader of the format.
    """
    if holds_tosses(path):
        return tosses.read_tosses(path)
    bag = gather_sensors(SensorGatherer(path, {}))
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
        )
    ]
