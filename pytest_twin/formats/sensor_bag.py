"""Collect poses, wrenches, inertial measurements and images of a bag, besides its joint states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pytest_twin.errors import FormatError, RecordingError
from pytest_twin.formats.bag import Channel, Contents, Region
from pytest_twin.formats.decompression import decompress_messages
from pytest_twin.formats.limits import MCAP
from pytest_twin.formats.message_collector import MessageCollector
from pytest_twin.formats.message_types import long_name
from pytest_twin.formats.recordings import reader_of
from pytest_twin.formats.recordings.base import BagReader
from pytest_twin.formats.ros_serialization import Encoding, Integers, MessageError
from pytest_twin.formats.sensor_messages import (
    IMAGES,
    POSES,
    TRANSFORMS,
    Picture,
    StampedMessage,
    picture_of,
    poses_of,
    stamp_of,
)
from pytest_twin.formats.stamped_readings import (
    READINGS,
    Reading,
    pose_of_json,
    reading_of,
    reading_of_json,
)
from pytest_twin.formats.topic_reader import TopicReader

_KINDS = (*POSES, *TRANSFORMS, *IMAGES, *READINGS)
_IN_JSON = ("geometry_msgs/msg/PoseStamped", *READINGS)


@dataclass
class SensorCollector(MessageCollector):
    """Collects poses, sensor readings and images, besides joint states.

    Attributes:
        poses: topic -> poses in the order of the file, ``/tf`` and ``/tf_static`` included.
        readings: topic -> wrenches or inertial measurements in the order of the file.
        reading_type: topic of readings -> message type.
        stamps: topic of images -> stamp of each image, ns.
        picture: callback with topic, index and image, for each image that ``wanted`` lists.
        wanted: topic -> indices of the images to decode.
    """

    path: Path
    state: Mapping[str, str]
    wanted: Mapping[str, frozenset[int]] = field(default_factory=dict)
    picture: Callable[[str, int, Picture], None] | None = None
    poses: dict[str, list[StampedMessage]] = field(default_factory=dict)
    readings: dict[str, list[Reading]] = field(default_factory=dict)
    reading_type: dict[str, str] = field(default_factory=dict)
    stamps: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        MessageCollector.__init__(self, self.path, self.state)

    def wants(self, topic: str, schema: str) -> bool:
        """Whether messages of a topic have to be read."""
        known = long_name(schema) in _KINDS
        return known or MessageCollector.wants(self, topic, schema)

    def take(self, region: Region, contents: Contents) -> None:
        """Collect all messages of a region."""
        MessageCollector.take(self, region, contents)
        for number in np.unique(region.channel).tolist():
            channel = contents.channels.get(number)
            declared = None if channel is None else contents.schemas.get(channel.schema_id)
            if channel is None or declared is None:
                continue
            kind = long_name(declared.name)
            if kind in _KINDS:
                self._sensed(region, np.flatnonzero(region.channel == number), channel, kind)

    def _sensed(self, region: Region, rows: Integers, channel: Channel, kind: str) -> None:
        known = ("cdr", "ros1", "json") if kind in _IN_JSON else ("cdr", "ros1")
        if channel.encoding not in known:
            raise RecordingError(
                f"messages of type {kind} are not read from this encoding",
                path=self.path, where=channel.topic, value=channel.encoding,
                expected=", ".join(known),
            )  # fmt: skip
        encoding: Encoding = "ros1" if channel.encoding == "ros1" else "cdr"
        if TopicReader.is_compressed(region, rows):
            region = decompress_messages(
                region, rows, MCAP.uncompressed_bytes, self.path, channel.topic
            )
            rows = np.arange(len(rows))
        for start, size in zip(region.start[rows], region.size[rows], strict=True):
            message = region.data[start : start + size]
            try:
                if kind in IMAGES:
                    self._image(message, channel.topic, kind, encoding)
                elif kind in READINGS:
                    json = channel.encoding == "json"
                    one = (
                        reading_of_json(message, kind)
                        if json
                        else reading_of(message, kind, encoding)
                    )
                    self.reading_type[channel.topic] = kind
                    self.readings.setdefault(channel.topic, []).append(one)
                elif channel.encoding == "json":
                    self.poses.setdefault(channel.topic, []).append(pose_of_json(message))
                else:
                    found = poses_of(message, kind, encoding)
                    self.poses.setdefault(channel.topic, []).extend(found)
            except MessageError as error:
                self.notes.add(channel.topic, f"a message that cannot be decoded: {error}")

    def _image(self, message: bytes, topic: str, kind: str, encoding: Encoding) -> None:
        stamps = self.stamps.setdefault(topic, [])
        number = len(stamps)
        stamps.append(stamp_of(message, encoding))
        if self.picture is not None and number in self.wanted.get(topic, ()):
            self.picture(topic, number, picture_of(message, kind, encoding))


def gather_sensors(collector: SensorCollector) -> SensorCollector:
    """Read the bag of a collector, and return the collector.

    Raises:
        TwinError: the bag cannot be read.
        FormatError: the recording is not message-based, such as a CSV file.
    """
    reader = reader_of(collector.path)
    if not isinstance(reader, BagReader):
        raise FormatError(
            f"a {reader.kind} cannot contain poses or images",
            path=collector.path,
            expected="an MCAP file, a rosbag2 folder, a .db3 file, or observations.csv",
        )
    reader.gather(collector.path, collector)
    collector.metadata = collector.trial_metadata()
    return collector
