"""Read MCAP files, also those compressed by rosbag2."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from pytest_twin.formats.mcap import gather_mcap, read_recording
from pytest_twin.formats.mcap_walk import MAGIC
from pytest_twin.formats.message_collector import MessageCollector
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings.base import ReadingOptions, first_bytes

SUFFIXES = (".mcap", ".mcap.zstd", ".mcap.zst")


class McapFile:
    """Reads MCAP files, recognized by their first bytes, or by their suffix if damaged."""

    kind: ClassVar[str] = "MCAP file"

    def reads(self, path: Path) -> bool:
        """Whether the file has the first bytes or a suffix of MCAP."""
        if not path.is_file():
            return False
        return first_bytes(path, len(MAGIC)) == MAGIC or path.name.lower().endswith(SUFFIXES)

    def read(self, path: Path, options: ReadingOptions) -> Sequence[Recording]:
        """Read the file as one recording."""
        return [read_recording(path, options.topics)]

    def gather(self, path: Path, collector: MessageCollector) -> None:
        """Pass all messages to ``collector``."""
        gather_mcap(path, collector)


__all__ = ["SUFFIXES", "McapFile"]
