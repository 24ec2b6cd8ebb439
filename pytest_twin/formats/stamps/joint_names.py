"""Names of the joints in a data set, as it writes them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

from pytest_twin.errors import TwinError
from pytest_twin.formats.mcap import gather_mcap
from pytest_twin.formats.message_collector import MessageCollector
from pytest_twin.formats.recordings.base import ReadingOptions
from pytest_twin.formats.recordings.lerobot import Dataset
from pytest_twin.formats.stamps.lerobot import LeRobotStamp
from pytest_twin.formats.topic_reader import TopicReader


def joint_names(path: Path, known: Collection[str]) -> tuple[str, ...]:
    """Joints of a LeRobot data set or an MCAP file, without values that have no name.

    Empty for HDF5 files and policies, which name no joints, and for data that cannot be read as a
    recording.

    Args:
        path: file or folder that can store a stamp.
        known: names that are expected. If one of them is in the first message of a topic, the later
            messages are not decoded.
    """
    try:
        if LeRobotStamp.is_dataset(path):
            dataset = Dataset(path, ReadingOptions())
            return _joined(feature.names for feature in dataset.features.values())
        if path.suffix.lower() == ".mcap":
            return _names_in_mcap(path, known)
    except TwinError:
        pass
    return ()


def _names_in_mcap(path: Path, known: Collection[str]) -> tuple[str, ...]:
    collector = MessageCollector(path, {})
    gather_mcap(path, collector)
    topics = [topic for topic in collector.topics.values() if topic.joints]
    first_names = _joined(topic.joints for topic in topics)
    if not first_names or not set(first_names).isdisjoint(known):
        return first_names
    # Drivers of several devices may publish on one topic: the first message names one of them.
    readers: list[TopicReader] = []
    for topic in topics:
        collector = MessageCollector(path, {topic.roles[0]: topic.name})
        gather_mcap(path, collector)
        readers += collector.readers.values()
    return _joined(tuple(reader.first_named) for reader in readers)


def _joined(lists: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for names in lists if not are_numbers(names) for name in names))


def are_numbers(names: Sequence[str]) -> bool:
    """Whether values were numbered from 0 for lack of names."""
    return tuple(names) == tuple(map(str, range(len(names))))
