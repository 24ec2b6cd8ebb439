"""What a reader of recordings is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from pytest_twin.formats.gather import Gatherer
from pytest_twin.formats.recording import TOPICS, Recording


@dataclass(frozen=True)
class Asked:
    """How a recording is to be read.

    Attributes:
        topics: role (``state``, ``command``) -> topic.
        columns: of a CSV file: header -> what the column is, or the other way round.
        units: of a LeRobot data set: ``deg``, ``rad``, or None to find out.
    """

    topics: Mapping[str, str] = field(default_factory=lambda: dict(TOPICS))
    columns: Mapping[str, str] = field(default_factory=dict)
    units: str | None = None


class Reader(Protocol):
    """Reads one kind of recording.

    Attributes:
        kind: what it reads, for people: ``rosbag2 folder``.
    """

    kind: ClassVar[str]

    def reads(self, path: Path) -> bool:
        """Whether an existing file or folder is of this kind; raises nothing."""
        ...

    def read(self, path: Path, asked: Asked) -> Sequence[Recording]:
        """Read it.

        Raises:
            TwinError: it cannot be read.
        """
        ...


@runtime_checkable
class BagReader(Protocol):
    """Reads recordings of messages: those of any topic can be gathered.

    Attributes:
        kind: what it reads, for people.
    """

    kind: ClassVar[str]

    def gather(self, path: Path, gatherer: Gatherer) -> None:
        """Give all messages to a gatherer.

        Raises:
            TwinError: it cannot be read.
        """
        ...


def first_bytes(path: Path, count: int) -> bytes:
    """The beginning of a regular file; empty for anything else."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as stream:
            return stream.read(count)
    except OSError:
        return b""
