"""What a check of a data set found, and what the data cannot show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Finding:
    """A property of a data set that is probably a fault.

    Attributes:
        code: kind, such as ``offset``.
        text: the finding with its numbers.
        next_step: how to confirm or correct it.
        joint: joint or camera; None for the whole data set.
        episodes: numbers of the affected episodes; empty for all.
    """

    code: str
    text: str
    next_step: str
    joint: str | None = None
    episodes: Sequence[int] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the finding as JSON data."""
        return {**asdict(self), "episodes": list(self.episodes)}


@dataclass(frozen=True, slots=True)
class Unknown:
    """A question that these data cannot answer.

    Attributes:
        what: the question's subject.
        why: why the data do not show it.
        next_step: what would.
    """

    what: str
    why: str
    next_step: str

    def to_json(self) -> dict[str, str]:
        """Return it as JSON data."""
        return asdict(self)
