"""Recordings: joint states and commands in MCAP files, read into arrays and written from them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import LimitError, RecordingError
from pytest_twin.formats import limits
from pytest_twin.formats.atomic import open_replacement
from pytest_twin.formats.joint_state import (
    QUANTITIES,
    SCHEMA_NAME,
    SCHEMA_TEXT,
    Batch,
    Floats,
    Integers,
    MessageError,
    decode_cdr,
    decode_json,
    encode_cdr,
)
from pytest_twin.formats.mcap_walk import Channel, Contents, Region, walk
from pytest_twin.formats.paths import open_regular
from pytest_twin.formats.recording import TOPICS, Damage, JointSeries, Recording

__all__ = [
    "TOPICS",
    "Damage",
    "JointSeries",
    "Recording",
    "read_recording",
    "write_recording",
]


def read_recording(path: Path, topics: Mapping[str, str] = TOPICS) -> Recording:
    """Read joint states and commands from an MCAP file.

    Messages are ``sensor_msgs/msg/JointState`` in CDR or the same fields in JSON. A damaged file
    is read as far as it goes, and every loss is noted in :attr:`Recording.damage`; times that do
    not increase, stand twice or are not set are noted there too and left as they are.

    Args:
        path: the file itself, not a link to it.
        topics: role -> topic.

    Raises:
        PathError: missing, a link, or no regular file.
        FormatError: not an MCAP file, or one that no writer makes.
        LimitError: beyond ``limits.MCAP``.
        RecordingError: a topic of another type or encoding, no message of it that can be decoded,
            or metadata records ``trial`` that differ.
    """
    contents = Contents()
    readers = {topic: _TopicReader(topic, path, contents) for topic in topics.values()}
    with open_regular(path) as stream:
        try:
            for region in walk(stream, path, contents):
                for channel, rows in _by_channel(region):
                    known = contents.channels.get(channel)
                    if known is None:
                        contents.notes.add(
                            region.place,
                            f"{len(rows)} messages of channel {channel}, which is not declared",
                        )
                    elif known.topic in readers:
                        readers[known.topic].read(region, rows, known)
        except OSError as error:
            raise RecordingError(f"cannot be read: {error.strerror}", path=path) from error
        except MemoryError:
            raise LimitError("too large for this machine's memory", path=path) from None
    series = {topic: reader.finish() for topic, reader in readers.items()}
    return Recording(
        path=path,
        series={role: found for role, topic in topics.items() if (found := series[topic])},
        metadata=_trial_metadata(contents.metadata, path),
        damage=contents.notes.all(),
    )


def write_recording(
    path: Path, series: Sequence[JointSeries], metadata: Mapping[str, str] | None = None
) -> None:
    """Write series as ``sensor_msgs/msg/JointState`` (CDR) to an MCAP file, whole or not at all.

    :func:`read_recording` reads the same series back. Rows in which a quantity is NaN for every
    joint are written as an empty field. The same data give the same bytes (with the same versions
    of ``mcap`` and ``zstandard``).

    Args:
        path: the file.
        series: one per topic.
        metadata: the metadata record ``trial``.

    Raises:
        RecordingError: shapes that do not agree, times before 1970 or after 2038, a topic twice.
        PathError: the file cannot be written.
    """
    from mcap.writer import CompressionType, Writer

    for one in series:
        _check_series(one, path)
    if len({one.topic for one in series}) != len(series):
        raise RecordingError("a topic stands twice", path=path)
    with open_replacement(path) as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="ros2", library="pytest-twin")
        if metadata:
            writer.add_metadata("trial", dict(sorted(metadata.items())))
        schema = writer.register_schema(SCHEMA_NAME, "ros2msg", SCHEMA_TEXT.encode())
        channels = [writer.register_channel(one.topic, "cdr", schema) for one in series]
        for index, log_time, message in _messages(series):
            writer.add_message(channels[index], log_time, message, log_time)
        writer.finish()  # type: ignore[no-untyped-call]


def _messages(series: Sequence[JointSeries]) -> Iterator[tuple[int, int, bytes]]:
    """(index of the series, log time in ns, CDR) by log time."""
    owner = np.concatenate(
        [np.full(len(one.stamp), index) for index, one in enumerate(series)] or [np.zeros(0, int)]
    )
    row = np.concatenate([np.arange(len(one.stamp)) for one in series] or [np.zeros(0, int)])
    log_time = np.concatenate([one.log_time for one in series] or [np.zeros(0, int)])
    order = np.argsort(log_time, kind="stable")
    names: dict[tuple[str, ...], bytes] = {}
    for index, at in zip(owner[order].tolist(), row[order].tolist(), strict=True):
        one = series[index]
        values: dict[str, list[float] | None] = {}
        for name in QUANTITIES:
            table: Floats | None = getattr(one, name)
            filled = table is not None and not np.isnan(table[at]).all()
            values[name] = table[at].tolist() if table is not None and filled else None
        yield index, int(one.log_time[at]), encode_cdr(one.names, int(one.stamp[at]), values, names)


def _check_series(one: JointSeries, path: Path) -> None:
    shape = (len(one.stamp), len(one.names))
    if not one.names or len(set(one.names)) != len(one.names):
        raise RecordingError("joints without names or twice", path=path, where=one.topic)
    if len(one.log_time) != shape[0]:
        raise RecordingError("stamps and log times differ in length", path=path, where=one.topic)
    for name in QUANTITIES:
        table: Floats | None = getattr(one, name)
        if table is not None and table.shape != shape:
            raise RecordingError(
                f"{name} has another shape than stamps and joints",
                path=path,
                where=one.topic,
                value=table.shape,
                expected=str(shape),
            )
    bound = 2**31 * 1_000_000_000
    times = np.concatenate([one.stamp, one.log_time])
    if times.size and not (times.min() >= 0 and times.max() < bound):
        raise RecordingError("a time out of the range of ROS stamps", path=path, where=one.topic)


def _by_channel(region: Region) -> Iterator[tuple[int, Integers]]:
    for channel in np.unique(region.channel).tolist():
        yield channel, np.flatnonzero(region.channel == channel)


@dataclass
class _TopicReader:
    """Gathers one topic's messages."""

    topic: str
    path: Path
    contents: Contents
    first_named: dict[str, tuple[int, int]] = field(default_factory=dict)
    order: list[Integers] = field(default_factory=list)
    log_times: list[Integers] = field(default_factory=list)
    batches: list[Batch] = field(default_factory=list)
    seen: int = 0
    samples: int = 0
    bad: int = 0
    first_bad: str = ""
    bad_stamps: int = 0
    checked: set[Channel] = field(default_factory=set)

    def read(self, region: Region, rows: Integers, channel: Channel) -> None:
        self.check(channel)
        starts, sizes = region.start[rows], region.size[rows]
        if channel.encoding == "cdr":
            for found in decode_cdr(region.data, starts, sizes):
                self.keep(found, region, rows)
        else:
            for row, (start, size) in enumerate(zip(starts.tolist(), sizes.tolist(), strict=True)):
                try:
                    self.keep(decode_json(region.data[start : start + size], row), region, rows)
                except MessageError as error:
                    self.keep((row, error), region, rows)
        self.seen += len(rows)

    def keep(self, found: Batch | tuple[int, MessageError], region: Region, rows: Integers) -> None:
        if isinstance(found, tuple):
            row, problem = found
            self.bad += 1
            self.first_bad = self.first_bad or (
                f"message {self.seen + row} ({region.place}, byte {int(region.start[rows[row]])} "
                f"of its content): {problem}"
            )
            if self.bad > limits.MCAP.undecodable_count:
                raise LimitError(
                    f"too many messages that cannot be decoded, first {self.first_bad}",
                    path=self.path,
                    where=self.topic,
                    expected=f"at most {limits.MCAP.undecodable_count}",
                )
            return
        self.take_names(found.names, self.seen + int(found.rows[0]))
        self.samples += len(found.rows) * len(found.names)
        if self.samples > limits.MCAP.samples_count:
            raise LimitError(
                "too many samples",
                path=self.path,
                where=self.topic,
                expected=f"at most {limits.MCAP.samples_count}",
            )
        self.order.append(found.rows + self.seen)
        self.log_times.append(region.log_time[rows[found.rows]])
        self.batches.append(found)
        self.bad_stamps += found.bad_stamp

    def take_names(self, names: tuple[str, ...], message: int) -> None:
        """Add joints to the topic's, with the message that names each first."""
        for place, name in enumerate(names):
            first = (message, place)
            if first < self.first_named.get(name, (message + 1, 0)):
                self.first_named[name] = first

    def check(self, channel: Channel) -> None:
        if channel in self.checked:
            return
        schema = self.contents.schemas.get(channel.schema_id)
        if channel.encoding not in ("cdr", "json"):
            raise RecordingError(
                "unknown message encoding",
                path=self.path,
                where=self.topic,
                value=channel.encoding,
                expected="cdr or json",
            )
        if channel.encoding == "cdr" and (schema is None or schema.name != SCHEMA_NAME):
            raise RecordingError(
                "unknown schema",
                path=self.path,
                where=self.topic,
                value="none" if schema is None else schema.name,
                expected=SCHEMA_NAME,
            )
        self.checked.add(channel)

    def finish(self) -> JointSeries | None:
        notes = self.contents.notes
        if self.bad:
            if not self.batches:
                raise RecordingError(
                    f"no message can be decoded, first {self.first_bad}",
                    path=self.path,
                    where=self.topic,
                    expected=SCHEMA_NAME,
                )
            notes.add(
                self.topic,
                f"{self.bad} of {self.seen} messages are lost, they cannot be decoded; first "
                f"{self.first_bad}",
            )
        if not self.batches:
            return None
        # Messages of one region come in any order.
        names = tuple(sorted(self.first_named, key=self.first_named.__getitem__))
        self.refuse_wide(len(names))
        order = np.argsort(np.concatenate(self.order), kind="stable")
        log_time = np.concatenate(self.log_times)[order]
        stamp = np.concatenate([batch.stamp for batch in self.batches])[order]
        series = JointSeries(
            topic=self.topic,
            names=names,
            stamp=self.mend_stamps(stamp, log_time),
            log_time=log_time,
            position=self.table("position", names, order),
            velocity=self.table("velocity", names, order),
            effort=self.table("effort", names, order),
        )
        carried = self.carried(names, order)
        for name in QUANTITIES:
            self.note_not_finite(name, getattr(series, name), names, carried)
        return series

    def refuse_wide(self, joints: int) -> None:
        """Messages of different joints make one table: it can be far larger than the file."""
        rows = sum(len(batch.rows) for batch in self.batches)
        if rows * joints > limits.MCAP.samples_count:
            raise LimitError(
                f"too many samples: {rows} messages that name {joints} joints between them",
                path=self.path,
                where=self.topic,
                expected=f"at most {limits.MCAP.samples_count}",
            )

    def table(self, name: str, names: tuple[str, ...], order: Integers) -> Floats | None:
        """(n, j) of one quantity; NaN where a message does not carry a joint."""
        if all(batch.values[name] is None for batch in self.batches):
            return None
        column = {joint: at for at, joint in enumerate(names)}
        parts = []
        for batch in self.batches:
            values = batch.values[name]
            if values is None or batch.names != names:
                whole = np.full((len(batch.rows), len(names)), np.nan)
                if values is not None:
                    whole[:, [column[joint] for joint in batch.names]] = values
                values = whole
            parts.append(values)
        table = np.concatenate(parts)
        in_order = bool((np.diff(order) == 1).all())
        return table if in_order else table[order]

    def mend_stamps(self, stamp: Integers, log_time: Integers) -> Integers:
        notes = self.contents.notes
        unset = int((stamp == 0).sum())
        if (log_time < 0).any():
            notes.add(self.topic, "log times beyond the year 2262, which read as negative here")
        if unset == len(stamp) and len(stamp) > 1:
            notes.add(self.topic, "no message has a header.stamp: the recorder's log time is used")
            stamp = log_time
        elif unset > 1 or (unset and stamp[0] != 0):
            at = int(np.flatnonzero(stamp == 0)[0])
            notes.add(self.topic, f"{unset} messages without header.stamp, first message {at}")
        if self.bad_stamps:
            notes.add(self.topic, f"{self.bad_stamps} stamps have nanosec of a second or more")
        step = np.diff(stamp)
        for what, bad in (("go back", step < 0), ("stand twice", step == 0)):
            if bad.any():
                at = int(np.flatnonzero(bad)[0]) + 1
                notes.add(self.topic, f"{int(bad.sum())} stamps {what}, first message {at}")
        return stamp

    def carried(self, names: tuple[str, ...], order: Integers) -> NDArray[np.bool_]:
        """(n, j) which joints each message names."""
        parts = []
        for batch in self.batches:
            named = set(batch.names)
            parts.append(np.tile([joint in named for joint in names], (len(batch.rows), 1)))
        table: NDArray[np.bool_] = np.concatenate(parts)[order]
        return table

    def note_not_finite(
        self,
        name: str,
        table: Floats | None,
        names: tuple[str, ...],
        carried: NDArray[np.bool_],
    ) -> None:
        if table is None:
            return
        bad = carried & ~np.isfinite(table)
        if not bad.any():
            return
        # A whole row of NaN is how an empty field reads.
        empty = np.isnan(table).all(axis=1)
        odd = np.flatnonzero(bad.any(axis=1) & ~empty)
        if odd.size:
            joint = names[int(np.flatnonzero(bad[odd[0]])[0])]
            self.contents.notes.add(
                self.topic,
                f"{name} is not finite in {odd.size} messages, first message {int(odd[0])}, "
                f"joint {joint!r}",
            )
        if empty.any():
            self.contents.notes.add(
                self.topic,
                f"{name} is empty in {int(empty.sum())} of {len(table)} messages, first message "
                f"{int(np.flatnonzero(empty)[0])}",
            )


def _trial_metadata(records: list[tuple[str, dict[str, str]]], path: Path) -> dict[str, str]:
    trials = [fields for name, fields in records if name == "trial"]
    if any(fields != trials[0] for fields in trials[1:]):
        raise RecordingError("metadata records 'trial' differ", path=path)
    return trials[0] if trials else {}
