"""Read MCAP files, also those compressed by rosbag2."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from pytest_twin.formats.gather import Gatherer
from pytest_twin.formats.mcap import gather_mcap, read_recording
from pytest_twin.formats.mcap_walk import MAGIC
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings.base import Asked, first_bytes

SUFFIXES = (".mcap", ".mcap.zstd", ".mcap.zst")


class McapFile:
    """Reads MCAP files, recognized by their first bytes, or by their suffix if damaged."""

    kind: ClassVar[str] = "MCAP file"

    def reads(self, path: Path) -> bool:
        """Whether the file has the first bytes or a suffix of MCAP."""
        if not path.is_file():
            return False
        return first_bytes(path, len(MAGIC)) == MAGIC or path.name.lower().endswith(SUFFIXES)

    def read(self, path: Path, asked: Asked) -> Sequence[Recording]:
        """Read the file as one recording."""
        return [read_recording(path, asked.topics)]

    def gather(self, path: Path, gatherer: Gatherer) -> None:
        """Pass all messages to ``gatherer``."""
        gather_mcap(path, gatherer)


__all__ = ["SUFFIXES", "McapFile"]
