"""Protocol of the files and data sets that can store a stamp."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

NAME = "twin"
"""Name of the metadata record, attribute or property that contains the stamp."""


class Carrier(Protocol):
    """One file or data set that can store a stamp."""

    @property
    def path(self) -> Path:
        """The file or folder."""
        ...

    def read(self) -> str | None:
        """Return the stamp's text, or None if there is no stamp.

        Raises:
            TwinError: the file violates its format.
        """
        ...

    def write(self, text: str) -> None:
        """Replace the stamp by ``text``, and change nothing else.

        Raises:
            TwinError: the file cannot be read or written.
        """
        ...

    def digest(self) -> str:
        """Return the SHA-256 of the content without the stamp, hex.

        Raises:
            TwinError: the file cannot be read.
        """
        ...
