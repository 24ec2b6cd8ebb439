"""What a log is told of long work."""

from __future__ import annotations

import time

_EACH = 60.0


class EachMinute:
    """The fraction done in words, each minute once; a terminal has better."""

    def __init__(self, name: str) -> None:
        """``name``: what is at work."""
        self.name = name
        self.since = self.told = time.monotonic()

    def line(self, fraction: float) -> str | None:
        """A line, where none was asked for within a minute."""
        now = time.monotonic()
        if now - self.told < _EACH:
            return None
        self.told = now
        return f"{self.name} {100.0 * fraction:3.0f} % after {(now - self.since) / 60.0:.0f} min"
