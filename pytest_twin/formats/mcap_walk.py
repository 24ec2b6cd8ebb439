"""Read the records of an MCAP file in order, also from damaged and unfinished files.

The reader neither needs nor trusts the index at the end of a file. It reads the data section from
its start and uses the summary only to find missing records. Format: https://mcap.dev/spec,
version 0.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pytest_twin.errors import FormatError, LimitError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.bag import Channel, Contents, Region, Schema

MAGIC = b"\x89MCAP0\r\n"

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX = range(9, 14)
SUMMARY_OFFSET, DATA_END = 14, 15
"""Opcodes of the records of an MCAP file."""

_RECORD = struct.Struct("<BQ")
_MESSAGE_BYTES = 22
"""Length of the fields of a message record before its data."""
_BLOCK_BYTES = 4 * 2**20
"""Number of bytes that are read at once."""
_MESSAGE_HEAD = np.dtype(
    {
        "names": ["size", "channel", "log_time"],
        "formats": ["<u8", "<u2", "<u8"],
        "offsets": [1, 9, 15],
        "itemsize": 9 + _MESSAGE_BYTES,
    }
)


def walk(stream: BinaryIO, path: Path, contents: Contents) -> Iterator[Region]:
    """Yield the messages of an MCAP file block by block, in file order, and fill ``contents``.

    Raises:
        FormatError: not an MCAP file, or a structure that no writer produces (a chunk in a chunk,
            a channel that is declared differently twice).
        LimitError: the file exceeds ``limits.MCAP``.
    """
    yield from _Walker(stream, path, contents).regions()


class _Walker:
    def __init__(self, stream: BinaryIO, path: Path, contents: Contents) -> None:
        self.stream = stream
        self.path = path
        self.contents = contents
        self.notes = contents.notes
        self.size = stream.seek(0, 2)
        stream.seek(0)
        self.at = 0
        self.crc = 0
        self.records = 0
        self.messages = 0
        self.most_messages = limits.MCAP.messages_of(self.size)
        self.uncompressed = 0
        self.most_uncompressed = limits.MCAP.unpacked_bytes_of(self.size)
        self.chunks: set[int] = set()
        self.declared: set[tuple[int, bytes]] = set()
        self.indexed: list[int] = []
        self.expected: dict[int, int] | None = None
        self.in_summary = False

    def regions(self) -> Iterator[Region]:
        require_at_most(
            self.size, limits.MCAP.file_bytes, "file is too large", unit="bytes", path=self.path
        )
        if self.take(len(MAGIC)) != MAGIC:
            raise FormatError(
                "not an MCAP file", path=self.path, expected="the MCAP magic in its first 8 bytes"
            )
        finished = False
        while self.at < self.size:
            start = self.at
            head = self.peek(9)
            if len(head) < 9:
                self.lose_rest(start, "the file ends inside a record's header")
                break
            opcode, length = _RECORD.unpack(head)
            if opcode == 0:
                self.lose_rest(start, "a record of type 0, which does not exist")
                break
            if length > self.size - start - 9:
                self.lose_rest(start, "a record reaches past the end of the file")
                break
            if opcode in (MESSAGE, SCHEMA, CHANNEL):
                yield from self.plain_records(start, length)
                if self.at == start:
                    break
                continue
            self.count_record()
            if opcode == CHUNK:
                yield from self.chunk(start, length)
            elif opcode == FOOTER:
                self.read_footer(start, length)
                finished = True
                break
            else:
                self.record(opcode, start, length)
        if not finished and self.at >= self.size:
            self.notes.add("end of file", "the recorder did not finish the file: no footer")
        self.compare_with_summary()

    # -- reading ---------------------------------------------------------------------------------

    def peek(self, count: int) -> bytes:
        data = self.stream.read(count)
        self.stream.seek(self.at)
        return data

    def take(self, count: int) -> bytes:
        """Read ``count`` bytes and add them to the running CRC."""
        data = self.stream.read(count)
        self.at += len(data)
        self.crc = zlib.crc32(data, self.crc)
        return data

    def skip(self, count: int) -> None:
        while count > 0:
            data = self.take(min(count, _BLOCK_BYTES))
            if not data:
                return
            count -= len(data)

    def lose_rest(self, start: int, why: str) -> None:
        if self.in_summary:
            self.notes.add(f"byte {start}", f"{why}; the summary is not complete")
        else:
            lost = self.size - start
            self.notes.add(f"byte {start}", f"{why}; the last {lost} bytes of the file are lost")
        self.stream.seek(start)

    def count_record(self) -> None:
        self.records += 1
        if self.records > limits.MCAP.records_count:
            raise LimitError(
                "too many records", path=self.path, expected=f"at most {limits.MCAP.records_count}"
            )

    # -- records ---------------------------------------------------------------------------------

    def plain_records(self, start: int, length: int) -> Iterator[Region]:
        """Yield messages that are stored outside chunks, many at a time."""
        block = self.peek(max(_BLOCK_BYTES, min(9 + length, limits.MCAP.message_bytes + 64)))
        region, used, problem = self.records_in(block, f"byte {start}", top=True)
        if used == 0:
            if problem is None:
                raise LimitError(
                    "a record is too large",
                    path=self.path,
                    where=f"byte {start}",
                    value=length,
                    unit="bytes",
                    expected=f"at most {limits.MCAP.message_bytes} bytes",
                )
            # Only the content is damaged, the length is valid: continue after the record.
            self.notes.add(f"byte {start}", problem)
            used = 9 + length
        self.skip(used)
        if region is None:
            return
        if self.in_summary:
            lost = len(region.start)
            self.notes.add(f"byte {start}", f"{lost} messages after the end of the data: not read")
        else:
            yield region

    def chunk(self, start: int, length: int) -> Iterator[Region]:
        require_at_most(
            length,
            limits.MCAP.chunk_bytes,
            "a chunk is too large",
            unit="bytes",
            path=self.path,
            where=f"byte {start}",
        )
        place = f"chunk at byte {start}"
        self.take(9)
        content = self.take(length)
        self.chunks.add(start)
        if self.in_summary:
            self.notes.add(place, "a chunk after the end of the data is not read")
            return
        try:
            fields = _Fields(content)
            first, last = fields.integer(8), fields.integer(8)
            size, crc = fields.integer(8), fields.integer(4)
            compression = fields.text()
            packed = fields.rest(fields.integer(8))
        except ValueError as error:
            self.notes.add(place, f"{error}; the chunk is lost")
            return
        span = f"the messages logged from {first} to {last} ns are lost"
        data = self.unpack(packed, compression, size, place, span)
        if data is None:
            return
        if crc and zlib.crc32(data) != crc:
            self.notes.add(place, f"its CRC is wrong; {span}")
            return
        region, used, problem = self.records_in(data, place, top=False)
        if problem is not None:
            self.notes.add(
                f"{place}, byte {used} of its content",
                f"{problem}; the last {len(data) - used} bytes of the chunk are lost",
            )
        if region is not None:
            yield region

    def unpack(
        self, packed: bytes, compression: str, size: int, place: str, span: str
    ) -> bytes | None:
        """Decompress a chunk without using more memory than it declares and the limits allow."""
        self.uncompressed += size
        for what, value, bound in (
            ("a chunk is too large after decompression", size, limits.MCAP.chunk_bytes),
            (
                f"too large after decompression for a file of {self.size} bytes",
                self.uncompressed,
                self.most_uncompressed,
            ),
        ):
            require_at_most(value, bound, what, unit="bytes", path=self.path, where=place)
        try:
            data = _decompress(packed, compression, size)
        except _UnknownCompressionError:
            self.notes.add(place, f"compression {compression[:40]!r} is not known; {span}")
            return None
        except ValueError as error:
            self.notes.add(place, f"cannot be decompressed ({error}); {span}")
            return None
        if len(data) > size:
            raise LimitError(
                "a chunk is larger after decompression than it declares",
                path=self.path,
                where=place,
                expected=f"{size} bytes",
            )
        if len(data) < size:
            self.notes.add(place, f"decompresses to {len(data)} of {size} bytes; {span}")
            return None
        return data

    def _declaration(self, opcode: int, content: bytes) -> str | None:
        """Add a schema or channel to ``contents``; return its defect, or None if it is valid."""
        self.count_record()
        try:
            # Some writers repeat all declarations in each chunk.
            if (opcode, content) not in self.declared:
                self.declare(opcode, content)
        except ValueError as error:
            return str(error)
        return None

    def records_in(
        self, data: bytes, place: str, *, top: bool
    ) -> tuple[Region | None, int, str | None]:
        """Add schemas and channels to ``contents`` and collect messages in a region.

        Returns:
            the region, the number of bytes read, and the defect that stopped reading before the
            end.
        """
        starts: list[int] = []
        append = starts.append
        unpack = _RECORD.unpack_from
        at, end = 0, len(data)
        left = self.most_messages - self.messages
        problem: str | None = None
        while at < end:
            if end - at < 9:
                problem = "a record is cut off"
                break
            opcode, length = unpack(data, at)
            after = at + 9 + length
            if after > end:
                problem = "a record is cut off"
                break
            if opcode == MESSAGE:
                if not _MESSAGE_BYTES <= length <= limits.MCAP.message_bytes + _MESSAGE_BYTES:
                    problem = f"a message of {length} bytes"
                    break
                append(at)
                if len(starts) > left:
                    raise LimitError(
                        f"too many messages for a file of {self.size} bytes",
                        path=self.path,
                        where=place,
                        expected=f"at most {self.most_messages}",
                    )
            elif opcode in (SCHEMA, CHANNEL):
                problem = self._declaration(opcode, data[at + 9 : after])
                if problem:
                    break
            elif top:
                break
            elif opcode == 0:
                problem = "a record of type 0, which does not exist"
                break
            elif opcode == CHUNK:
                raise FormatError(
                    "a chunk inside a chunk",
                    path=self.path,
                    where=place,
                    expected="schemas, channels and messages in a chunk; record it again",
                )
            else:
                self.count_record()
                self.notes.add(
                    f"{place}, byte {at} of its content",
                    f"a record of type {opcode}, which no chunk holds, is not read",
                )
            at = after
        # Outside chunks a block may end inside a record; the next block starts at that record.
        if top and problem == "a record is cut off":
            problem = None
        self.messages += len(starts)
        if not starts:
            return None, at, problem
        offsets = np.array(starts, dtype=np.int64)
        width = _MESSAGE_HEAD.itemsize
        heads = np.ndarray(
            (len(data) - width + 1,), dtype=_MESSAGE_HEAD, buffer=data, strides=(1,)
        )[offsets]
        region = Region(
            data=data,
            place=place,
            channel=heads["channel"].astype(np.int64),
            log_time=heads["log_time"].astype(np.int64),
            start=offsets + width,
            size=heads["size"].astype(np.int64) - _MESSAGE_BYTES,
        )
        ids, counts = np.unique(region.channel, return_counts=True)
        for channel, count in zip(ids.tolist(), counts.tolist(), strict=True):
            total = self.contents.message_counts.get(channel, 0) + count
            self.contents.message_counts[channel] = total
        return region, at, problem

    def declare(self, opcode: int, content: bytes) -> None:
        fields = _Fields(content)
        number = fields.integer(2)
        if opcode == SCHEMA:
            found: Schema | Channel = Schema(fields.text(), fields.text())
            table: dict[int, Schema] | dict[int, Channel] = self.contents.schemas
            if number == 0:
                raise ValueError("a schema of number 0")
        else:
            found = Channel(fields.integer(2), fields.text(), fields.text())
            table = self.contents.channels
        known = table.get(number)
        if known is not None and known != found:
            name = "schema" if opcode == SCHEMA else "channel"
            if self.in_summary:
                self.notes.add("summary", f"{name} {number} differs between summary and data")
                return
            raise FormatError(
                f"{name} {number} changes its meaning within the file",
                path=self.path,
                value=str(found),
                expected=str(known),
            )
        if len(table) >= limits.MCAP.channels_count and known is None:
            raise LimitError(
                "too many channels or schemas",
                path=self.path,
                expected=f"at most {limits.MCAP.channels_count}",
            )
        table[number] = found  # type: ignore[assignment]
        self.declared.add((opcode, content))

    def record(self, opcode: int, start: int, length: int) -> None:
        """Process a record that contains no messages."""
        crc_before = self.crc
        self.take(9)
        small = length <= limits.MCAP.metadata_bytes
        if opcode in (METADATA, STATISTICS, CHUNK_INDEX, DATA_END) and small:
            content = self.take(length)
            try:
                self.read_record(opcode, content, crc_before)
            except ValueError as error:
                self.notes.add(f"byte {start}", f"a record of type {opcode} is not read: {error}")
            return
        self.skip(length)
        if opcode == METADATA:
            raise LimitError(
                "a metadata record is too large",
                path=self.path,
                where=f"byte {start}",
                value=length,
                unit="bytes",
                expected=f"at most {limits.MCAP.metadata_bytes} bytes",
            )
        if opcode > DATA_END or opcode in (STATISTICS, CHUNK_INDEX, DATA_END):
            self.notes.add(f"byte {start}", f"a record of type {opcode} is not read")

    def read_record(self, opcode: int, content: bytes, crc_before: int) -> None:
        fields = _Fields(content)
        if opcode == METADATA:
            self.contents.metadata.append((fields.text(), fields.pairs()))
            require_at_most(
                len(self.contents.metadata),
                limits.MCAP.channels_count,
                "too many metadata records",
                path=self.path,
            )
        elif opcode == CHUNK_INDEX:
            fields.integer(16)
            self.indexed.append(fields.integer(8))
        elif opcode == STATISTICS:
            fields.rest(8 + 2 + 4 * 4 + 8 + 8)
            counts = _Fields(fields.rest(fields.integer(4)))
            self.expected = {}
            while counts.left:
                channel = counts.integer(2)
                self.expected[channel] = counts.integer(8)
        else:
            stated = fields.integer(4)
            self.contents.has_checksum = stated != 0
            if stated and stated != crc_before:
                self.notes.add("data section", "its CRC is wrong: something in it has changed")
            self.in_summary = True
            self.crc = 0

    def read_footer(self, start: int, length: int) -> None:
        head_and_places = self.take(9 + 16)
        crc = self.crc
        stated = int.from_bytes(self.take(4), "little")
        if length != 20 or len(head_and_places) != 25:
            self.notes.add(f"byte {start}", "the footer has the wrong length")
            return
        if not self.in_summary:
            self.notes.add(f"byte {start}", "a footer before the end of the data section")
        elif stated and stated != crc:
            self.notes.add("summary", "its CRC is wrong; it is not used")
            self.expected, self.indexed = None, []
        if self.take(len(MAGIC) + 1) != MAGIC:
            self.notes.add("end of file", "the file does not end with the MCAP magic")

    def compare_with_summary(self) -> None:
        """Note records that the summary lists and the data section lacks."""
        for start in self.indexed:
            if start not in self.chunks:
                self.notes.add(f"chunk at byte {start}", "is in the index and missing in the data")
        if self.expected is None:
            return
        found = self.contents.message_counts
        for channel in sorted(self.expected.keys() | found.keys()):
            stated, read = self.expected.get(channel, 0), found.get(channel, 0)
            if stated != read:
                topic = self.contents.channels.get(channel)
                name = f"channel {channel}" if topic is None else topic.topic
                self.notes.add(name, f"{read} of {stated} messages that the summary counts")


class _UnknownCompressionError(ValueError):
    pass


def _decompress(packed: bytes, compression: str, size: int) -> bytes:
    """Return the decompressed data, at most ``size`` + 1 bytes.

    Raises:
        ValueError: the data is damaged.
    """
    if compression == "":
        return packed
    if compression == "zstd":
        import zstandard

        decompressor = zstandard.ZstdDecompressor(max_window_size=2**27)
        try:
            # The library allocates the size that the frame states: accept only the declared size.
            if zstandard.frame_content_size(packed) == size:
                return decompressor.decompress(packed, max_output_size=size)
            with decompressor.stream_reader(packed, read_across_frames=True) as reader:
                return bytes(reader.read(size + 1))
        except (zstandard.ZstdError, MemoryError) as error:
            raise ValueError(str(error)[:80] or "out of memory") from None
    if compression == "lz4":
        import lz4.frame

        try:
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
        except (RuntimeError, EOFError, MemoryError) as error:
            raise ValueError(str(error)[:80] or "out of memory") from None
    raise _UnknownCompressionError


class _Fields:
    """Reads the fields of one record; raises ValueError if they exceed the record."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def rest(self, count: int) -> bytes:
        if count > self.left:
            raise ValueError("a record's fields are longer than the record")
        self.at += count
        return self.data[self.at - count : self.at]

    def integer(self, count: int) -> int:
        return int.from_bytes(self.rest(count), "little")

    def text(self, bound: int = limits.MCAP.name_bytes) -> str:
        size = self.integer(4)
        if size > bound:
            raise ValueError(f"text of {size} bytes")
        try:
            return self.rest(size).decode("utf-8")
        except UnicodeDecodeError:
            raise ValueError("text that is not UTF-8") from None

    def pairs(self) -> dict[str, str]:
        inner = _Fields(self.rest(self.integer(4)))
        found: dict[str, str] = {}
        while inner.left:
            key = inner.text()
            if key in found:
                raise ValueError(f"key {key[:40]!r} twice")
            found[key] = inner.text(limits.MCAP.metadata_bytes)
        return found
