"""Read and write the stamp of an MCAP file: a metadata record ``twin``.

The record is appended to the data section, and the index at the end of the file is rewritten.
All messages keep their bytes and positions. Format: https://mcap.dev/spec, version 0.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

from pytest_twin.errors import FormatError, LimitError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.atomic import open_replacement
from pytest_twin.formats.mcap_walk import (
    ATTACHMENT_INDEX,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    MAGIC,
    METADATA,
    METADATA_INDEX,
    STATISTICS,
    SUMMARY_OFFSET,
)
from pytest_twin.formats.paths import open_regular
from pytest_twin.formats.stamps.base import NAME

_KEY = "stamp"
_HEAD = struct.Struct("<BQ")
_FOOTER_BYTES = 20
"""Length of the content of a footer record."""
_SUMMARY_BYTES = 256 * 2**20
"""Largest size of a summary section that is read."""
_BLOCK_BYTES = 4 * 2**20
"""Number of bytes that are read at once."""


@dataclass(frozen=True, slots=True)
class _Record:
    """Type and byte range of one record, header included."""

    opcode: int
    start: int
    end: int


@dataclass(frozen=True, slots=True)
class _Layout:
    """Byte positions and checksums in a file.

    Attributes:
        data_end: start of the record that ends the data section.
        data_crc: stated CRC of the data section, 0 if there is none.
        summary: records of the index, as (type, content).
        has_offsets: whether the file lists the positions of the groups of its index.
        summary_crc: stated CRC of the index, 0 if there is none.
        metadata: metadata records of the data section.
        stamps: those of them that are stamps.
    """

    data_end: int
    data_crc: int
    summary: tuple[tuple[int, bytes], ...]
    has_offsets: bool
    summary_crc: int
    metadata: tuple[_Record, ...]
    stamps: tuple[_Record, ...]


@dataclass(frozen=True, slots=True)
class McapStamp:
    """An MCAP recording.

    The digest covers all records of the data section except stamps.
    """

    path: Path

    def read(self) -> str | None:
        """Return the text of the newest stamp, or None."""
        with open_regular(self.path) as stream:
            layout = self._layout(stream)
            if not layout.stamps:
                return None
            found = self._metadata(stream, layout.stamps[-1])
        text = found.metadata.get(_KEY)
        if not isinstance(text, str):
            raise self._damaged(f"a metadata record {NAME!r} without {_KEY!r}")
        return text

    def write(self, text: str) -> None:
        """Rewrite the file with the record, atomically."""
        from mcap.exceptions import EndOfFile
        from mcap.records import Metadata

        with open_regular(self.path) as stream, open_replacement(self.path) as target:
            layout = self._layout(stream)
            crc = 0
            for start, end in _kept_ranges(layout.stamps, layout.data_end):
                crc = _copy(stream, target, start, end, crc)
            place = target.tell()
            record = _bytes_of(Metadata(NAME, {_KEY: text}))
            target.write(record)
            crc = zlib.crc32(record, crc)
            target.write(_HEAD.pack(DATA_END, 4) + struct.pack("<I", crc if layout.data_crc else 0))
            try:
                target.write(_rest(layout, target.tell(), place, len(record)))
            except (EndOfFile, struct.error, UnicodeDecodeError):
                raise self._damaged("a record of its index is cut off") from None

    def digest(self) -> str:
        """Return the SHA-256 of the records, with chunks in compressed form, hex."""
        hashed = hashlib.sha256()
        with open_regular(self.path) as stream:
            layout = self._layout(stream)
            for start, end in _kept_ranges(layout.stamps, layout.data_end):
                stream.seek(start)
                for block in _blocks(stream, end - start):
                    hashed.update(block)
        return hashed.hexdigest()

    def trial(self) -> dict[str, str]:
        """Return the metadata record ``trial`` of the recording; empty without one."""
        with open_regular(self.path) as stream:
            for record in self._layout(stream).metadata:
                found = self._metadata(stream, record)
                if found.name == "trial":
                    return dict(found.metadata)
        return {}

    def _damaged(self, problem: str) -> FormatError:
        return FormatError(
            f"not a whole MCAP file: {problem}",
            path=self.path,
            expected="a finished file; pytest-twin convert writes one from what can be read",
        )

    def _layout(self, stream: BinaryIO) -> _Layout:
        size = stream.seek(0, 2)
        stream.seek(0)
        if stream.read(len(MAGIC)) != MAGIC:
            raise self._damaged("no MCAP magic in its first 8 bytes")
        tail = 9 + _FOOTER_BYTES + len(MAGIC)
        stream.seek(max(0, size - tail))
        footer = stream.read(tail)
        if len(footer) < tail or footer[-len(MAGIC) :] != MAGIC or footer[0] != FOOTER:
            raise self._damaged("no footer")
        summary_start, offset_start, summary_crc = struct.unpack_from("<QQI", footer, 9)
        metadata: list[_Record] = []
        for record in self._records(stream, len(MAGIC), size - tail):
            if record.opcode == DATA_END:
                break
            if record.opcode == METADATA:
                metadata.append(record)
        else:
            raise self._damaged("its data section does not end")
        stream.seek(record.start + 9)
        (data_crc,) = struct.unpack("<I", stream.read(4))
        summary = self._summary(
            stream, summary_start, offset_start or size - tail, record.end, size - tail
        )
        stamps = tuple(each for each in metadata if self._metadata(stream, each).name == NAME)
        return _Layout(
            record.start,
            data_crc,
            summary,
            bool(offset_start),
            summary_crc,
            tuple(metadata),
            stamps,
        )

    def _records(self, stream: BinaryIO, start: int, end: int) -> Iterator[_Record]:
        count = 0
        while start < end:
            stream.seek(start)
            head = stream.read(9)
            opcode, length = _HEAD.unpack(head) if len(head) == 9 else (0, 0)
            if not opcode or start + 9 + length > end:
                raise self._damaged(f"a record at byte {start} is cut off")
            count += 1
            if count > limits.MCAP.messages_of(end):
                raise LimitError(
                    "too many records", path=self.path, value=count,
                    expected=f"at most {limits.MCAP.messages_of(end)} in a file of this size",
                )  # fmt: skip
            yield _Record(opcode, start, start + 9 + length)
            start += 9 + length

    def _summary(
        self, stream: BinaryIO, start: int, end: int, data_end: int, footer: int
    ) -> tuple[tuple[int, bytes], ...]:
        if not start:
            return ()
        if not data_end <= start <= end <= footer:
            raise self._damaged("its footer points outside the index")
        require_at_most(
            end - start, _SUMMARY_BYTES, "its index is too large", unit="bytes", path=self.path
        )
        found = []
        for record in self._records(stream, start, end):
            stream.seek(record.start + 9)
            found.append((record.opcode, stream.read(record.end - record.start - 9)))
        return tuple(found)

    def _metadata(self, stream: BinaryIO, record: _Record) -> Any:
        from mcap.data_stream import ReadDataStream
        from mcap.exceptions import EndOfFile
        from mcap.records import Metadata

        length = record.end - record.start - 9
        require_at_most(
            length,
            limits.STAMPS.stamp_bytes,
            "a metadata record is too large",
            unit="bytes",
            path=self.path,
        )
        stream.seek(record.start + 9)
        try:
            return Metadata.read(ReadDataStream(io.BytesIO(stream.read(length))))
        except (EndOfFile, struct.error, UnicodeDecodeError):
            raise self._damaged(f"a metadata record at byte {record.start}") from None


def _kept_ranges(left_out: Sequence[_Record], end: int) -> Iterator[tuple[int, int]]:
    """Yield the byte ranges from the file's start to ``end``, without the records ``left_out``."""
    start = 0
    for record in left_out:
        yield start, record.start
        start = record.end
    yield start, end


def _blocks(stream: BinaryIO, length: int) -> Iterator[bytes]:
    while length > 0:
        block = stream.read(min(length, _BLOCK_BYTES))
        if not block:
            return
        yield block
        length -= len(block)


def _copy(stream: BinaryIO, target: BinaryIO, start: int, end: int, crc: int) -> int:
    stream.seek(start)
    for block in _blocks(stream, end - start):
        target.write(block)
        crc = zlib.crc32(block, crc)
    return crc


def _bytes_of(record: Any) -> bytes:
    """Serialize a record of the MCAP library, header included."""
    from mcap.data_stream import RecordBuilder

    builder: Any = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def _rest(layout: _Layout, start: int, place: int, length: int) -> bytes:
    """Serialize index, offsets, footer and magic, for an index that begins at ``start``."""
    from mcap.records import MetadataIndex

    records = list(_adjust_index(layout)) if layout.summary else []
    if records:
        index = _bytes_of(MetadataIndex(offset=place, length=length, name=NAME))
        at = max((i for i, (op, _) in enumerate(records) if op == METADATA_INDEX), default=-1)
        # A group of the index is contiguous: insert next to its kind, or append a new group.
        records.insert(at + 1 if at >= 0 else len(records), (METADATA_INDEX, index[9:]))
    body = bytearray()
    groups: list[list[int]] = []
    for opcode, content in records:
        record = _HEAD.pack(opcode, len(content)) + content
        if groups and groups[-1][0] == opcode:
            groups[-1][2] += len(record)
        else:
            groups.append([opcode, start + len(body), len(record)])
        body += record
    offset_start = start + len(body) if layout.has_offsets and records else 0
    if offset_start:
        for opcode, begin, size in groups:
            body += _HEAD.pack(SUMMARY_OFFSET, 17) + struct.pack("<BQQ", opcode, begin, size)
    footer = _HEAD.pack(FOOTER, _FOOTER_BYTES)
    footer += struct.pack("<QQ", start if records else 0, offset_start)
    crc = zlib.crc32(footer, zlib.crc32(body)) if layout.summary_crc else 0
    return bytes(body) + footer + struct.pack("<I", crc) + MAGIC


def _adjust_index(layout: _Layout) -> Iterator[tuple[int, bytes]]:
    """Yield the index records, adjusted to data without earlier stamps and with one new record."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import AttachmentIndex, ChunkIndex, MetadataIndex, Statistics

    def now(offset: int) -> int:
        return offset - sum(r.end - r.start for r in layout.stamps if r.start < offset)

    for opcode, content in layout.summary:
        stream = ReadDataStream(io.BytesIO(content))
        record: Any
        if opcode == CHUNK_INDEX:
            record = ChunkIndex.read(stream)
            record = replace(
                record,
                chunk_start_offset=now(record.chunk_start_offset),
                message_index_offsets={
                    channel: now(offset) for channel, offset in record.message_index_offsets.items()
                },
            )
        elif opcode == ATTACHMENT_INDEX:
            record = AttachmentIndex.read(stream)
            record = replace(record, offset=now(record.offset))
        elif opcode == METADATA_INDEX:
            record = MetadataIndex.read(stream)
            if record.name == NAME:
                continue
            record = replace(record, offset=now(record.offset))
        elif opcode == STATISTICS:
            record = Statistics.read(stream)
            count = record.metadata_count - len(layout.stamps) + 1
            record = replace(record, metadata_count=count)
        else:
            yield opcode, content
            continue
        yield opcode, _bytes_of(record)[9:]
