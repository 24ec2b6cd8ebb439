"""What every carrier of a stamp does."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

NAME = "twin"
"""Of the metadata record, attribute or property that holds the stamp."""


class Carrier(Protocol):
    """One file or data set with a place for a stamp."""

    @property
    def path(self) -> Path:
        """The file or folder."""
        ...

    def read(self) -> str | None:
        """The stamp's text, None where there is none.

        Raises:
            TwinError: the file cannot be read as what it claims to be.
        """
        ...

    def write(self, text: str) -> None:
        """Write the text in place of an earlier stamp, and change nothing else.

        Raises:
            TwinError: the file cannot be read or written.
        """
        ...

    def digest(self) -> str:
        """SHA-256 of the stamped content without the stamp itself, hex.

        Raises:
            TwinError: the file cannot be read.
        """
        ...
