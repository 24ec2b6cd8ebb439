"""A property that does not hold: which element, by how much."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

_SHOWN = 4


@dataclass(frozen=True, slots=True)
class Broken:
    """One number beyond its tolerance.

    Attributes:
        element: of the robot, ``joint 'elbow'``.
        what: what is wrong there, in words.
        amount, tolerance, unit: by how much, and how much is let pass.
        forms: the realizations that it was seen on.
    """

    element: str
    what: str
    amount: float
    tolerance: float
    unit: str
    forms: str

    @property
    def excess(self) -> float:
        """Amount in tolerances; infinite for what has no amount."""
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
    """A property that does not hold.

    Attributes:
        property: its name.
        broken: all that is beyond tolerance, worst first.
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
