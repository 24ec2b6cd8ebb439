"""Protocol of recording readers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from pytest_twin.formats.message_collector import MessageCollector
from pytest_twin.formats.recording import TOPICS, Recording


@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading a recording.

    Attributes:
        topics: role (``state``, ``command``) -> topic.
        columns: for a CSV file: header -> meaning of the column, or the inverse mapping.
        units: ``deg``, ``rad`` or ``percent`` (LeRobot), None for the unit of the format. Only the
            reader of LeRobot data sets converts; :func:`read_recordings` does for the others.
        time_unit: for a CSV file: ``s``, ``ms``, ``us`` or ``ns``, or None to detect the unit.
        motor_calibration: for a LeRobot data set: the JSON file of the arm's motors.
        has_signals: whether unit and side of the positions are declared elsewhere.
    """

    topics: Mapping[str, str] = field(default_factory=lambda: dict(TOPICS))
    columns: Mapping[str, str] = field(default_factory=dict)
    units: str | None = None
    time_unit: str | None = None
    motor_calibration: Path | None = None
    has_signals: bool = False


class Reader(Protocol):
    """Reads one recording format.

    Attributes:
        kind: name of the format in messages, such as ``rosbag2 folder``.
    """

    kind: ClassVar[str]

    def reads(self, path: Path) -> bool:
        """Whether an existing file or folder has this format; raises nothing."""
        ...

    def read(self, path: Path, options: ReadingOptions) -> Sequence[Recording]:
        """Read the recordings at ``path``.

        Raises:
            TwinError: ``path`` cannot be read.
        """
        ...


@runtime_checkable
class BagReader(Protocol):
    """Reads a message-based format, from which messages of any topic can be collected.

    Attributes:
        kind: name of the format in messages.
    """

    kind: ClassVar[str]

    def gather(self, path: Path, collector: MessageCollector) -> None:
        """Pass all messages to ``collector``.

        Raises:
            TwinError: ``path`` cannot be read.
        """
        ...


def first_bytes(path: Path, count: int) -> bytes:
    """Return the first ``count`` bytes of a regular file; empty for anything else."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as stream:
            return stream.read(count)
    except OSError:
        return b""
