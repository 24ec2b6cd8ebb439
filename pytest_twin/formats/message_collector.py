"""Collect the messages of one or more bag files into a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pytest_twin.errors import LimitError, RecordingError
from pytest_twin.formats.bag import Channel, Contents, Region
from pytest_twin.formats.decompression import decompress_messages
from pytest_twin.formats.joint_state import SCHEMA_NAME
from pytest_twin.formats.message_types import (
    TRAJECTORIES,
    MessageType,
    encodings_of,
    long_name,
    message_type,
)
from pytest_twin.formats.recording import Damage, JointSeries, Notes, Recording, Topic
from pytest_twin.formats.ros_serialization import (
    QUANTITIES,
    Batch,
    Encoding,
    Integers,
    MessageError,
)
from pytest_twin.formats.topic_reader import TopicReader

_ROLES = ("state", "command")
# Limits the bytes read from topics that are listed but not used.
_LOOK_BYTES = 2**20


class MessageCollector:
    """Collects the messages of a bag's files, file by file, and builds a recording.

    Args:
        path: the file or folder of the recording.
        topics: role (``state``, ``command``) -> topic.
    """

    def __init__(self, path: Path, topics: Mapping[str, str]) -> None:
        self.path = path
        self.notes = Notes()
        self.remarks = Notes()
        self.metadata: dict[str, str] = {}
        self.files: list[tuple[Path, Contents]] = []
        self.readers = {
            role: TopicReader(topic, role, path, self.notes, self.remarks)
            for role, topic in topics.items()
        }
        self.topics: dict[str, Topic] = {}

    def wants(self, topic: str, schema: str) -> bool:
        """Whether a topic's messages have to be read; messages of other topics are only counted."""
        if any(reader.topic == topic for reader in self.readers.values()):
            return True
        return any(message_type(schema, role) is not None for role in _ROLES)

    def file(self, path: Path) -> Contents:
        """Begin a file; the reader fills the returned contents with the file's declarations."""
        contents = Contents()
        self.files.append((path, contents))
        return contents

    def take(self, region: Region, contents: Contents) -> None:
        """Collect all messages of a region, and note messages of undeclared channels."""
        for number in np.unique(region.channel).tolist():
            rows = np.flatnonzero(region.channel == number)
            channel = contents.channels.get(number)
            if channel is None:
                contents.notes.add(
                    region.place,
                    f"{len(rows)} messages of channel {number}, which is not declared",
                )
                continue
            declared = contents.schemas.get(channel.schema_id)
            schema = None if declared is None else declared.name
            for reader in self.readers.values():
                if reader.topic == channel.topic:
                    reader.read(region, rows, channel, schema)
            self.look(region, rows, channel, schema)

    def count(self, contents: Contents, counts: Mapping[int, int]) -> None:
        """Add counts of messages that are not read: channel -> number of messages."""
        for number, messages in counts.items():
            channel = contents.channels[number]
            schema = contents.schemas.get(channel.schema_id)
            name = "" if schema is None else long_name(schema.name)
            known = self.topics.get(channel.topic, Topic(channel.topic, name, 0))
            self.topics[channel.topic] = replace(known, messages=known.messages + messages)

    def look(self, region: Region, rows: Integers, channel: Channel, schema: str | None) -> None:
        """Count the messages of a topic, and decode the first for its joints."""
        known = self.topics.get(channel.topic)
        name = long_name(schema or "")
        roles = tuple(role for role in _ROLES if message_type(name, role) is not None)
        if known is None:
            known = Topic(channel.topic, name, 0, roles)
        if not roles and channel.encoding == "json":
            # JSON needs no schema: a JointState is recognized by its fields.
            name, roles = SCHEMA_NAME, _ROLES
        if roles and not known.joints and channel.encoding in encodings_of(name):
            first = _first(region, rows[:1], channel, message_type(name, roles[0]), self.path)
            if first is not None:
                filled = tuple(q for q in QUANTITIES if first.values[q] is not None)
                known = replace(known, roles=roles, joints=first.names, filled=filled)
        self.topics[channel.topic] = replace(known, messages=known.messages + len(rows))

    def recording(self) -> Recording:
        """Return the recording.

        Raises:
            RecordingError: no message of a topic can be decoded, or metadata records ``trial``
                that differ.
            LimitError: beyond ``limits.MCAP``.
        """
        series: dict[str, JointSeries] = {}
        for role in sorted(self.readers, key=lambda role: role == "command"):
            joint_series = self.readers[role].finish(series.get("state"))
            if joint_series is not None:
                series[role] = joint_series
        metadata = self.trial_metadata()
        if not self._has_checksum_for_metadata():
            self.remarks.add(
                "metadata 'trial'",
                "no checksum covers it (the file has no data CRC): a changed value would go unseen",
            )
        if any(reader.schema in TRAJECTORIES for reader in self.readers.values()):
            metadata.setdefault("command_between", "interpolated")
        return Recording(
            path=self.path,
            series=series,
            metadata=metadata,
            damage=(*self._damage_of_files(), *self.notes.all()),
            notes=tuple(str(note) for note in self.remarks.all()),
            topics=tuple(self.topics[name] for name in sorted(self.topics)),
        )

    def _damage_of_files(self) -> list[Damage]:
        several = len(self.files) > 1
        return [
            replace(note, place=f"{path.name} {note.place}") if several else note
            for path, contents in self.files
            for note in contents.notes.all()
        ]

    def trial_metadata(self) -> dict[str, str]:
        """Return the trial's metadata; the record ``trial`` overrides that of ``metadata.yaml``.

        Raises:
            RecordingError: metadata records ``trial`` that differ.
        """
        found = [fields for fields, _ in self._trial_records()]
        if any(fields != found[0] for fields in found[1:]):
            raise RecordingError(
                "metadata records 'trial' differ",
                path=self.path,
                expected="the same record in each file; pass files of different trials separately",
            )
        return self.metadata | dict(found[0] if found else {})

    def _has_checksum_for_metadata(self) -> bool:
        """Whether all metadata records are covered by a checksum, or there are none."""
        found = self._trial_records()
        return not found or any(guarded for _, guarded in found)

    def _trial_records(self) -> list[tuple[dict[str, str], bool]]:
        return [
            (dict(fields), contents.has_checksum)
            for _, contents in self.files
            for name, fields in contents.metadata
            if name == "trial"
        ]


def _first(
    region: Region, rows: Integers, channel: Channel, kind: MessageType | None, path: Path
) -> Batch | None:
    """Decode the first message of a topic; None if that fails."""
    if kind is None or int(region.size[rows[0]]) > _LOOK_BYTES:
        return None
    try:
        if TopicReader.is_compressed(region, rows):
            region = decompress_messages(region, rows, _LOOK_BYTES, path, channel.topic)
            rows = np.zeros(1, np.int64)
        start, size = region.start[rows], region.size[rows]
        if channel.encoding == "json":
            return kind.from_json(region.data[start[0] : start[0] + size[0]], 0)
        encoding: Encoding = "ros1" if channel.encoding == "ros1" else "cdr"
        found = next(kind.serialized(region.data, start, size, encoding), None)
    except (MessageError, LimitError):
        return None
    return found if isinstance(found, Batch) else None
