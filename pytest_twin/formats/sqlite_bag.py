"""Read the SQLite files of rosbag2 (``.db3``): tables ``topics`` and ``messages``.

The file is opened as immutable, and the connection may only read these two tables. Triggers, views
and functions of a hostile file therefore never run.
"""

from __future__ import annotations

import contextlib
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from pytest_twin.errors import FormatError, LimitError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.bag import Channel, Contents, Region, Schema
from pytest_twin.formats.decompression import ZSTD_MAGIC, decompressed_file
from pytest_twin.formats.message_collector import MessageCollector
from pytest_twin.formats.paths import open_regular

MAGIC = b"SQLite format 3\0"
# Page size, change counter, pages, and the change counter that the pages were counted at
# (https://sqlite.org/fileformat2.html, section 1.3).
_HEADER = struct.Struct(">16xH6xII60xI")

_REGION_BYTES = 16 * 2**20
"""Size of a region of messages that is read at once."""
_REGION_ROWS = 100_000
"""Largest number of messages of such a region."""
# A scan takes about ten steps of SQLite's virtual machine for each row.
_STEPS_A_ROW = 200
_STEPS_FREE = 10_000_000
"""Number of steps of SQLite's virtual machine that are allowed for any file."""
_STEPS_AT_ONCE = 100_000
"""Number of steps between two checks of this limit."""
# Error codes of damage that leaves the beginning of the file readable.
_DAMAGED = {
    sqlite3.SQLITE_CORRUPT,
    sqlite3.SQLITE_CORRUPT_INDEX,
    sqlite3.SQLITE_CORRUPT_SEQUENCE,
    sqlite3.SQLITE_CORRUPT_VTAB,
    sqlite3.SQLITE_IOERR_SHORT_READ,
    sqlite3.SQLITE_TOOBIG,
}
_TABLES = {"messages", "topics", "sqlite_master"}
_ALLOWED = {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ}


def gather_sqlite(path: Path, collector: MessageCollector) -> None:
    """Read one SQLite file of a bag, also one compressed by rosbag2.

    Raises:
        PathError: missing, a link, or no regular file.
        FormatError: not an SQLite file of rosbag2.
        LimitError: the file exceeds ``limits.MCAP``.
        RecordingError: a topic has an unsupported type or encoding.
    """
    contents = collector.file(path)
    with open_regular(path) as stream:
        size = stream.seek(0, 2)
        require_at_most(size, limits.MCAP.file_bytes, "file is too large", unit="bytes", path=path)
        stream.seek(0)
        magic = stream.read(len(MAGIC))
        if magic[:4] == ZSTD_MAGIC:
            with decompressed_file(stream, path) as unpacked:
                _Database(Path(unpacked.name), path, contents, collector).read()
            return
    if magic != MAGIC:
        raise FormatError("not an SQLite file", path=path, expected="a .db3 file of rosbag2")
    log = path.with_name(path.name + "-wal")
    if log.exists() and log.stat().st_size:
        contents.notes.add(
            log.name,
            "a write-ahead log that was never merged into the file: its messages are not read "
            f"(merge it with: sqlite3 {path.name} 'PRAGMA wal_checkpoint')",
        )
    _Database(path, path, contents, collector).read()


class _Database:
    def __init__(
        self, file: Path, path: Path, contents: Contents, collector: MessageCollector
    ) -> None:
        self.file, self.path, self.contents, self.collector = file, path, contents, collector
        self.size = file.stat().st_size
        self.steps = 0
        self.most_steps = _STEPS_FREE + _STEPS_A_ROW * limits.MCAP.messages_of(self.size)
        self.messages = 0

    def read(self) -> None:
        self.note_cut()
        uri = f"file:{quote(str(self.file.absolute()))}?mode=ro&immutable=1"
        try:
            with contextlib.closing(sqlite3.connect(uri, uri=True)) as connection:
                self.confine(connection)
                self.topics(connection)
                for region in self.regions(connection):
                    self.collector.take(region, self.contents)
        except sqlite3.Error as error:
            if self.steps > self.most_steps:
                raise LimitError(
                    f"reading takes too many steps for a file of {self.size} bytes",
                    path=self.path,
                    expected=f"at most {self.most_steps} of SQLite's",
                ) from None
            if error.sqlite_errorcode not in _DAMAGED or not self.contents.channels:
                raise FormatError(
                    f"not an SQLite file of rosbag2: {str(error)[:120]}",
                    path=self.path,
                    expected="tables topics and messages",
                ) from None
            self.contents.notes.add(
                f"after {self.messages} messages",
                f"the file is damaged ({str(error)[:120]}); the rest is lost",
            )
        except UnicodeDecodeError:
            # SQLite's error message quotes bytes of a damaged schema, which are not valid text.
            raise FormatError(
                "the database's schema is damaged",
                path=self.path,
                expected="tables topics and messages",
            ) from None
        except MemoryError:
            raise LimitError(
                "too large for this machine's memory",
                path=self.path,
                expected="a shorter recording, or more free memory",
            ) from None

    def note_cut(self) -> None:
        """Note a truncated file, whose missing end SQLite silently reads as zeros."""
        with self.file.open("rb") as stream:
            head = stream.read(_HEADER.size)
        if len(head) < _HEADER.size:
            return
        page_bytes, changes, pages, valid_for = _HEADER.unpack(head)
        stated = pages * (65536 if page_bytes == 1 else page_bytes)
        if changes == valid_for and self.size < stated:
            self.contents.notes.add(
                "end of file", f"cut off: {self.size} of {stated} bytes; messages are lost"
            )

    def confine(self, connection: sqlite3.Connection) -> None:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits.MCAP.message_bytes)
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA cell_size_check = ON")
        connection.text_factory = bytes
        connection.set_progress_handler(self.progress, _STEPS_AT_ONCE)
        tables = {
            name.decode("utf-8", "replace"): (kind, (sql or b"").upper())
            for name, kind, sql in connection.execute(
                "SELECT name, type, sql FROM sqlite_master WHERE name IN ('topics', 'messages')"
            )
        }
        for name in ("topics", "messages"):
            kind, sql = tables.get(name, (b"nothing", b""))
            if kind != b"table" or b"VIRTUAL" in sql or b"GENERATED" in sql:
                raise FormatError(
                    f"not an SQLite file of rosbag2: {name!r} is not a plain table",
                    path=self.path,
                    expected="tables topics and messages",
                )
        connection.set_authorizer(_authorize)

    def progress(self) -> int:
        self.steps += _STEPS_AT_ONCE
        return int(self.steps > self.most_steps)

    def topics(self, connection: sqlite3.Connection) -> None:
        rows = connection.execute("SELECT id, name, type, serialization_format FROM topics")
        for number, name, kind, form in rows:
            if len(self.contents.channels) >= limits.MCAP.channels_count:
                raise LimitError(
                    "too many topics",
                    path=self.path,
                    expected=f"at most {limits.MCAP.channels_count}",
                )
            if type(number) is not int:
                raise FormatError(
                    "a topic's id is not a number",
                    path=self.path,
                    where="topics",
                    value=number,
                    expected="a whole number",
                )
            self.contents.schemas[number] = Schema(self.text(kind), "")
            self.contents.channels[number] = Channel(number, self.text(name), self.text(form))

    def text(self, value: object) -> str:
        if not isinstance(value, bytes) or len(value) > limits.MCAP.name_bytes:
            raise FormatError(
                "a topic without a usable name or type",
                path=self.path,
                where="topics",
                value=value,
                expected=f"text of at most {limits.MCAP.name_bytes} bytes",
            )
        return value.decode("utf-8", "replace")

    def regions(self, connection: sqlite3.Connection) -> Iterator[Region]:
        """Yield messages in the order in which they were written."""
        schemas = self.contents.schemas
        known = [
            number
            for number, channel in self.contents.channels.items()
            if self.collector.wants(
                channel.topic, schemas[number].name if number in schemas else ""
            )
        ]
        others = set(self.contents.channels) - set(known)
        if others:
            self.collector.count(self.contents, self.counts(connection, others))
        marks = ",".join("?" * len(set(known)))
        # Column and table names are constants: only the numbers come from the file.
        query = (
            "SELECT topic_id, timestamp, data FROM messages "
            f"WHERE topic_id IN ({marks}) ORDER BY rowid"
        )
        block = _Block()
        for number, time, data in connection.execute(query, sorted(set(known))):
            if type(number) is not int or type(time) is not int or not isinstance(data, bytes):
                raise FormatError(
                    f"row {self.messages + 1} is not a message",
                    path=self.path,
                    where="messages",
                    expected="whole numbers as topic_id and timestamp, bytes as data",
                )
            self.messages += 1
            if self.messages > limits.MCAP.messages_of(self.size):
                raise LimitError(
                    f"too many messages for a file of {self.size} bytes",
                    path=self.path,
                    expected=f"at most {limits.MCAP.messages_of(self.size)}",
                )
            block.add(number, time, data)
            if block.is_full:
                yield block.region(self.messages)
                block = _Block()
        if block.rows:
            yield block.region(self.messages)

    @staticmethod
    def counts(connection: sqlite3.Connection, numbers: set[int]) -> dict[int, int]:
        rows = connection.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id")
        return {number: count for number, count in rows if number in numbers}


class _Block:
    """Collects messages for one region."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, int]] = []
        self.parts: list[bytes] = []
        self.bytes = 0

    def add(self, number: int, time: int, data: bytes) -> None:
        self.rows.append((number, time, len(data)))
        self.parts.append(data)
        self.bytes += len(data)

    @property
    def is_full(self) -> bool:
        return self.bytes > _REGION_BYTES or len(self.rows) >= _REGION_ROWS

    def region(self, until: int) -> Region:
        table = np.array(self.rows, dtype=np.int64)
        return Region(
            data=b"".join(self.parts),
            place=f"messages {until - len(self.rows)} to {until - 1}",
            channel=table[:, 0],
            log_time=table[:, 1],
            start=np.cumsum(table[:, 2]) - table[:, 2],
            size=table[:, 2],
        )


def _authorize(action: int, first: str | None, second: str | None, *_: Any) -> int:
    if action == sqlite3.SQLITE_FUNCTION and second == "count":
        return sqlite3.SQLITE_OK
    if action not in _ALLOWED:
        return sqlite3.SQLITE_DENY
    if action == sqlite3.SQLITE_READ and first not in _TABLES:
        return sqlite3.SQLITE_DENY
    return sqlite3.SQLITE_OK


__all__ = ["MAGIC", "gather_sqlite"]
