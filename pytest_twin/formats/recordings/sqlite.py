"""Read single SQLite files of rosbag2, without their folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from pytest_twin.formats.message_collector import MessageCollector
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings.base import ReadingOptions, first_bytes
from pytest_twin.formats.sqlite_bag import MAGIC, gather_sqlite

SUFFIXES = (".db3", ".db3.zstd", ".db3.zst")


class SqliteFile:
    """Reads ``.db3`` files of rosbag2."""

    kind: ClassVar[str] = "SQLite file of rosbag2"

    def reads(self, path: Path) -> bool:
        """Whether the file has the first bytes or the suffix of SQLite bags."""
        if not path.is_file():
            return False
        return first_bytes(path, len(MAGIC)) == MAGIC or path.name.lower().endswith(SUFFIXES)

    def read(self, path: Path, options: ReadingOptions) -> Sequence[Recording]:
        """Read the file as one recording."""
        collector = MessageCollector(path, options.topics)
        self.gather(path, collector)
        return [collector.recording()]

    def gather(self, path: Path, collector: MessageCollector) -> None:
        """Pass all messages to ``collector``."""
        gather_sqlite(path, collector)
