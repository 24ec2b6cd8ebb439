"""Progress lines of long work for a log, at most one each minute."""

from __future__ import annotations

import time

_INTERVAL_SECONDS = 60.0
"""Smallest time between two lines."""


class ProgressLog:
    """Reports the fraction done and the remaining time once a minute."""

    def __init__(self, work: str) -> None:
        self.work = work
        self.started = self.last = time.monotonic()

    def line(self, fraction: float, stage: str = "") -> str | None:
        """Return one line of text, or None if the last line is less than a minute old.

        Args:
            fraction: fraction done, 0 to 1.
            stage: name of the present stage.
        """
        now = time.monotonic()
        if now - self.last < _INTERVAL_SECONDS:
            return None
        self.last = now
        elapsed = now - self.started
        line = f"{self.work} {100.0 * fraction:3.0f} % after {elapsed / 60.0:.0f} min"
        if 0.0 < fraction < 1.0:
            # extrapolated from the speed so far
            left = elapsed * (1.0 - fraction) / fraction
            line += f", about {max(1.0, left / 60.0):.0f} min left"
        return f"{line}: {stage}" if stage else line
