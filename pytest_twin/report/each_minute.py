"""How far long work is, for a log."""

from __future__ import annotations

import time

_INTERVAL_SECONDS = 60.0


class EachMinute:
    """Says once a minute how much of the work is done and how long it still takes.

    Args:
        work: what is done.
    """

    def __init__(self, work: str) -> None:
        self.work = work
        self.started = self.last = time.monotonic()

    def line(self, fraction: float, stage: str = "") -> str | None:
        """Return one line of text, or None where the last is less than a minute old.

        Args:
            fraction: done so far, 0 to 1.
            stage: what is done at the moment.
        """
        now = time.monotonic()
        if now - self.last < _INTERVAL_SECONDS:
            return None
        self.last = now
        elapsed = now - self.started
        line = f"{self.work} {100.0 * fraction:3.0f} % after {elapsed / 60.0:.0f} min"
        if 0.0 < fraction < 1.0:
            # At the pace so far.
            left = elapsed * (1.0 - fraction) / fraction
            line += f", about {max(1.0, left / 60.0):.0f} min left"
        return f"{line}: {stage}" if stage else line
