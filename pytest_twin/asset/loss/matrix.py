"""Data types of the semantic-loss matrix."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Verdict = Literal["kept", "changed", "lost", "none"]
"""``none`` means that neither side has the feature."""


@dataclass(frozen=True, slots=True)
class Item:
    """One named element that was changed or lost.

    Attributes:
        before, after: values before and after the conversion, with units; None if absent.
    """

    name: str
    verdict: Verdict
    before: str | None
    after: str | None


@dataclass(frozen=True, slots=True)
class Row:
    """One feature of one conversion.

    Attributes:
        before, after: summaries before and after the conversion.
        comparison: how both sides were compared.
        difference: the largest measured difference, in ``unit``; None without a measurement.
        tolerance: largest difference that counts as kept.
        items: elements that were changed or lost.
        critical: whether the loss makes the realization unusable.
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
    """One conversion.

    Attributes:
        problem: reason why the realization does not exist; ``rows`` is then empty.
        critical: whether the problem is a failure; a missing optional package is not.
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
        """Return critical problems and rows, one line of text each."""
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
