"""Violations of a property: element and amount."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

_SHOWN = 4
"""Largest number of printed violations."""


@dataclass(frozen=True, slots=True)
class Broken:
    """Violation of a property.

    Attributes:
        element: element of the robot, ``joint 'elbow'``.
        amount, tolerance: deviation and largest allowed deviation, in ``unit``.
        unit: SI unit.
    """

    element: str
    what: str
    amount: float
    tolerance: float
    unit: str
    forms: str

    @property
    def excess(self) -> float:
        """Ratio of amount to tolerance; infinite for a violation without an amount."""
        if not math.isfinite(self.amount):
            return math.inf
        return self.amount / self.tolerance if self.tolerance > 0 else math.inf

    def __str__(self) -> str:
        by = ""
        if math.isfinite(self.amount):
            unit = f" {self.unit}" if self.unit else ""
            by = f" by {self.amount:.4g}{unit} (tolerance {self.tolerance:.2g}{unit})"
        return f"{self.element}: {self.what}{by}, {self.forms}"


class PropertyError(AssertionError):
    """Failure of a property.

    Attributes:
        broken: all violations, the largest first.
    """

    def __init__(
        self, name: str, asset: str, broken: Iterable[Broken], q: Mapping[str, float] | None
    ) -> None:
        self.property = name
        self.broken = tuple(sorted(broken, key=lambda b: b.excess, reverse=True))
        lines = [f"{asset}: {name.replace('_', ' ')} does not hold"]
        lines += [f"  {item}" for item in self.broken[:_SHOWN]]
        if len(self.broken) > _SHOWN:
            lines.append(f"  and {len(self.broken) - _SHOWN} more")
        if q is not None:
            pose = ", ".join(f"{joint} {value:.6g}" for joint, value in q.items() if value)
            lines.append(f"  at {pose or 'zero'} (rad, m)")
        super().__init__("\n".join(lines))
