"""Decompress rosbag2's Zstandard compression, of each message or of a whole file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.bag import Region
from pytest_twin.formats.ros_serialization import Integers
from pytest_twin.formats.temporary import temporary_file

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_BLOCK_BYTES = 4 * 2**20
"""Number of bytes that are decompressed at once."""


def decompress_messages(
    region: Region, rows: Integers, bytes_left: int, path: Path, topic: str
) -> Region:
    """Decompress messages that are Zstandard frames; a damaged one becomes an empty message.

    Args:
        region: block with the compressed messages.
        rows: indices of the messages to decompress.
        bytes_left: largest total size after decompression, bytes.
        path, topic: named in errors.

    Raises:
        LimitError: the total exceeds ``bytes_left``, or one message exceeds ``limits.MCAP``.
    """
    import zstandard

    decompressor = zstandard.ZstdDecompressor(max_window_size=2**27)
    parts: list[bytes] = []
    total = 0
    for start, size in zip(region.start[rows].tolist(), region.size[rows].tolist(), strict=True):
        packed = region.data[start : start + size]
        try:
            stated = zstandard.frame_content_size(packed)
            # The library would allocate the size that the frame states, so check it first.
            if stated > min(limits.MCAP.message_bytes, bytes_left - total):
                raise LimitError(
                    "a compressed message is too large",
                    path=path,
                    where=topic,
                    value=stated,
                    unit="bytes",
                    expected=f"at most {limits.MCAP.message_bytes} bytes each and "
                    f"{limits.MCAP.uncompressed_bytes} in all",
                )
            bound = min(limits.MCAP.message_bytes, max(1, bytes_left - total))
            parts.append(decompressor.decompress(packed, max_output_size=bound))
        except (zstandard.ZstdError, MemoryError):
            parts.append(b"")
        total += len(parts[-1])
    sizes = np.array([len(part) for part in parts], dtype=np.int64)
    return Region(
        data=b"".join(parts),
        place=region.place,
        channel=region.channel[rows],
        log_time=region.log_time[rows],
        start=np.cumsum(sizes) - sizes,
        size=sizes,
    )


@contextlib.contextmanager
def decompressed_file(stream: BinaryIO, path: Path) -> Iterator[BinaryIO]:
    """Decompress a Zstandard file into a temporary file, which is deleted after the block.

    Args:
        path: its name, used in errors.

    Raises:
        FormatError: the file is damaged.
        LimitError: the content is larger than ``limits.MCAP`` allows for a file of this size.
    """
    import zstandard

    packed_bytes = stream.seek(0, 2)
    stream.seek(0)
    bound = min(limits.MCAP.file_bytes, limits.MCAP.unpacked_bytes_of(packed_bytes))
    with temporary_file() as (unpacked, _), unpacked.open("w+b") as out:
        written = 0
        decompressor = zstandard.ZstdDecompressor(max_window_size=2**27)
        try:
            with decompressor.stream_reader(stream, read_across_frames=True) as reader:
                while block := reader.read(_BLOCK_BYTES):
                    written += len(block)
                    if written > bound:
                        raise LimitError(
                            "the compressed file is too large after decompression",
                            path=path,
                            expected=f"at most {bound} bytes from {packed_bytes}",
                        )
                    out.write(block)
        except (zstandard.ZstdError, MemoryError) as error:
            if not written:
                raise FormatError(f"cannot be decompressed: {str(error)[:80]}", path=path) from None
        out.flush()
        out.seek(0)
        yield cast("BinaryIO", out)
