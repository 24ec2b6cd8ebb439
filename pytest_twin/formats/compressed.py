"""Zstandard as rosbag2 uses it: around each message, or around a whole file."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.bag import Region
from pytest_twin.formats.serialized import Integers

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_BLOCK_BYTES = 4 * 2**20


def unpacked_messages(
    region: Region, rows: Integers, bytes_left: int, path: Path, topic: str
) -> Region:
    """Messages that are each a Zstandard frame, unpacked; a broken one becomes an empty message.

    Args:
        region: where they lie.
        rows: which of its messages.
        bytes_left: how much they may unpack to.
        path, topic: for errors.

    Raises:
        LimitError: they unpack to more than that, or one to more than ``limits.MCAP`` allows.
    """
    import zstandard

    decompressor = zstandard.ZstdDecompressor(max_window_size=2**27)
    parts: list[bytes] = []
    total = 0
    for start, size in zip(region.start[rows].tolist(), region.size[rows].tolist(), strict=True):
        packed = region.data[start : start + size]
        try:
            stated = zstandard.frame_content_size(packed)
            # A frame's own size would be allocated as it says.
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
def unpacked_file(stream: BinaryIO, path: Path) -> Iterator[BinaryIO]:
    """A temporary file with the content of a Zstandard file, gone after the block.

    Args:
        stream: the compressed file.
        path: its name, for errors.

    Raises:
        FormatError: damaged.
        LimitError: it unpacks to more than ``limits.MCAP`` allows for a file of its size.
    """
    import zstandard

    packed_bytes = stream.seek(0, 2)
    stream.seek(0)
    bound = min(limits.MCAP.file_bytes, limits.MCAP.unpacked_bytes_of(packed_bytes))
    with tempfile.NamedTemporaryFile(prefix="pytest-twin-") as out:
        written = 0
        decompressor = zstandard.ZstdDecompressor(max_window_size=2**27)
        try:
            with decompressor.stream_reader(stream, read_across_frames=True) as reader:
                while block := reader.read(_BLOCK_BYTES):
                    written += len(block)
                    if written > bound:
                        raise LimitError(
                            "the compressed file unpacks to too much",
                            path=path,
                            expected=f"at most {bound} bytes from {packed_bytes}",
                        )
                    out.write(block)
        except (zstandard.ZstdError, MemoryError) as error:
            if not written:
                raise FormatError(f"cannot be unpacked: {str(error)[:80]}", path=path) from None
        out.flush()
        out.seek(0)
        yield cast("BinaryIO", out)
