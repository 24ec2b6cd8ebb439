"""Read MCAP recordings into arrays, and write arrays as MCAP recordings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import LimitError, RecordingError
from pytest_twin.formats.atomic import open_replacement
from pytest_twin.formats.bag import Contents
from pytest_twin.formats.decompression import ZSTD_MAGIC, decompressed_file
from pytest_twin.formats.joint_state import SCHEMA_NAME, SCHEMA_TEXT, encode_cdr
from pytest_twin.formats.mcap_walk import walk
from pytest_twin.formats.message_collector import MessageCollector
from pytest_twin.formats.paths import open_regular
from pytest_twin.formats.recording import TOPICS, Damage, JointSeries, Recording
from pytest_twin.formats.ros_serialization import QUANTITIES, Floats

__all__ = [
    "TOPICS",
    "Damage",
    "JointSeries",
    "Recording",
    "gather_mcap",
    "read_recording",
    "write_recording",
]


def read_recording(path: Path, topics: Mapping[str, str] = TOPICS) -> Recording:
    """Read joint states and commands from an MCAP file, also one compressed by rosbag2.

    A damaged file is read as far as possible, and every loss is noted in
    :attr:`Recording.damage`. Times that do not increase, occur twice or are not set are noted
    there too and left unchanged.

    Args:
        path: the file; links are refused.
        topics: role (``state``, ``command``) -> topic.

    Raises:
        PathError: missing, a link, or no regular file.
        FormatError: not an MCAP file, or a structure that no writer produces.
        LimitError: the file exceeds ``limits.MCAP``.
        RecordingError: a topic has an unsupported type or encoding, none of its messages can be
            decoded, or the file's metadata records ``trial`` differ.
    """
    collector = MessageCollector(path, topics)
    gather_mcap(path, collector)
    return collector.recording()


def gather_mcap(path: Path, collector: MessageCollector) -> None:
    """Read one MCAP file of a recording; raises as :func:`read_recording`."""
    contents = collector.file(path)
    with open_regular(path) as stream:
        try:
            magic = stream.read(4)
            stream.seek(0)
            if magic == ZSTD_MAGIC:
                with decompressed_file(stream, path) as unpacked:
                    _gather(unpacked, path, contents, collector)
            else:
                _gather(stream, path, contents, collector)
        except OSError as error:
            raise RecordingError(f"cannot be read: {error.strerror}", path=path) from error
        except MemoryError:
            raise LimitError(
                "too large for this machine's memory",
                path=path,
                expected="a shorter recording, or more free memory",
            ) from None


def _gather(stream: BinaryIO, path: Path, contents: Contents, collector: MessageCollector) -> None:
    for region in walk(stream, path, contents):
        collector.take(region, contents)


def write_recording(
    path: Path, series: Sequence[JointSeries], metadata: Mapping[str, str] | None = None
) -> None:
    """Write series as ``sensor_msgs/msg/JointState`` (CDR) to an MCAP file, atomically.

    :func:`read_recording` reads the same series back. A message omits joints that have no value in
    its row. A quantity that is NaN for all other joints is written as an empty field. The same
    data give the same bytes (with the same versions of ``mcap`` and ``zstandard``).

    Args:
        series: one series per topic.
        metadata: content of the metadata record ``trial``.

    Raises:
        RecordingError: shapes differ, a time is before 1970 or after 2038, or a topic occurs twice.
        PathError: the file cannot be written.
    """
    from mcap.writer import CompressionType, Writer

    for one in series:
        _check_series(one, path)
    topics = [one.topic for one in series]
    if len(set(topics)) != len(topics):
        raise RecordingError(
            "two series have the same topic",
            path=path,
            value=", ".join(topics),
            expected="one series for each topic",
        )
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
    """Yield (index of the series, log time in ns, CDR bytes), ordered by log time."""
    owner = np.concatenate(
        [np.full(len(one.stamp), index) for index, one in enumerate(series)] or [np.zeros(0, int)]
    )
    row = np.concatenate([np.arange(len(one.stamp)) for one in series] or [np.zeros(0, int)])
    log_time = np.concatenate([one.log_time for one in series] or [np.zeros(0, int)])
    order = np.argsort(log_time, kind="stable")
    encoded: dict[tuple[str, ...], bytes] = {}
    carried = [_has_value(one) for one in series]
    for index, at in zip(owner[order].tolist(), row[order].tolist(), strict=True):
        one, named = series[index], carried[index][at]
        names, keep = one.names, slice(None)
        if not named.all() and named.any():
            names = tuple(name for name, has in zip(names, named, strict=True) if has)
            keep = named
        values: dict[str, list[float] | None] = {}
        for name in QUANTITIES:
            table: Floats | None = getattr(one, name)
            some = None if table is None else table[at][keep]
            values[name] = None if some is None or np.isnan(some).all() else some.tolist()
        yield index, int(one.log_time[at]), encode_cdr(names, int(one.stamp[at]), values, encoded)


def _has_value(one: JointSeries) -> NDArray[np.bool_]:
    """Return for which joints each message has a value, as (n, j) booleans."""
    found = np.zeros((len(one.stamp), len(one.names)), dtype=bool)
    for name in QUANTITIES:
        table: Floats | None = getattr(one, name)
        if table is not None:
            found |= ~np.isnan(table)
    return found


def _check_series(one: JointSeries, path: Path) -> None:
    shape = (len(one.stamp), len(one.names))
    if not one.names or len(set(one.names)) != len(one.names):
        raise RecordingError(
            "no joints, or one joint twice",
            path=path,
            where=one.topic,
            value=", ".join(one.names),
            expected="the name of each joint once",
        )
    if len(one.log_time) != shape[0]:
        raise RecordingError(
            "stamps and log times differ in length",
            path=path,
            where=one.topic,
            value=f"{len(one.log_time)} log times",
            expected=f"{shape[0]}, one for each stamp",
        )
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
        raise RecordingError(
            "a time out of the range of ROS stamps",
            path=path,
            where=one.topic,
            value=f"{times.min()} to {times.max()}",
            unit="ns",
            expected=f"0 to {bound - 1} ns, times from 1970 to 2038",
        )
