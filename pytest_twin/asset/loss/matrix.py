"""The semantic-loss matrix: nouns only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

Verdict = Literal["kept", "changed", "lost", "none"]
"""``none``: neither side has any."""


@dataclass(frozen=True, slots=True)
class Item:
    """One named thing that is not as it was.

    Attributes:
        before, after: what the two sides hold, with units; None where a side has none.
    """

    name: str
    verdict: Verdict
    before: str | None
    after: str | None


@dataclass(frozen=True, slots=True)
class Row:
    """One feature across a conversion.

    Attributes:
        before, after: both sides in words.
        comparison: what was run or read to tell.
        difference: the largest that was measured, in ``unit``; None where nothing is measured.
        tolerance: up to which it counts as kept.
        items: what is not as it was, by name.
        critical: the realization cannot be trusted.
    """

    feature: str
    verdict: Verdict
    before: str
    after: str
    comparison: str
    difference: float | None = None
    tolerance: float | None = None
    unit: str = ""
    items: tuple[Item, ...] = ()
    critical: bool = False


@dataclass(frozen=True, slots=True)
class Conversion:
    """From one form to another.

    Attributes:
        problem: why there is no such realization; ``rows`` is then empty.
        critical: whether that fails the asset; an extra that is not installed does not.
    """

    source: str
    target: str
    engine: str
    rows: tuple[Row, ...] = ()
    problem: str | None = None
    critical: bool = False


@dataclass(frozen=True, slots=True)
class Matrix:
    """All conversions of one asset."""

    robot: str
    source: str
    conversions: tuple[Conversion, ...]

    @property
    def critical(self) -> list[str]:
        """What fails, one line each."""
        found = []
        for conversion in self.conversions:
            name = f"{conversion.source} -> {conversion.target}"
            if conversion.critical:
                found.append(f"{name}: {conversion.problem}")
            found += [
                f"{name}: {row.feature}: {row.before} -> {row.after}"
                for row in conversion.rows
                if row.critical
            ]
        return found

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
        return {"schema": 1, **asdict(self), "critical": self.critical}


def worst(verdicts: Sequence[Verdict]) -> Verdict:
    """The gravest of them: lost, changed, kept, none."""
    order: tuple[Verdict, ...] = ("lost", "changed", "kept", "none")
    return min(verdicts, key=order.index, default="none")
