"""What the numbers amount to, in one word."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["no_mismatch", "explained", "improved", "unexplained"]

AT_FLOOR = 3.0
"""Root mean square up to this many floors is at the floor: it is an estimate itself, and a real
joint's micro-slip and a simulator's contact law leave a few of it."""
STANDS_OUT = 1.5
"""A signal up to this many floors holds nothing that could be named."""
LEFT = 0.02
"""Share of the squared mismatch that may be left and still count as explained, ..."""
LEFT_FLOORS = 10.0
"""... up to this many floors: a large mismatch leaves a large remainder, which is one."""


@dataclass(frozen=True, slots=True)
class JointError:
    """Prediction error of one joint, root mean squares in ``unit``.

    Attributes:
        before: of the model as it came.
        after: with the findings.
        floor: what noise, timing and discretization leave.
        unit: rad or m.
    """

    before: float
    after: float
    floor: float
    unit: str

    @property
    def fraction(self) -> float:
        """Share of the squared mismatch above the floor that is left."""
        mismatch = self.before**2 - self.floor**2
        left = self.after**2 - self.floor**2
        if left <= 0.0:
            return 0.0
        return min(left / mismatch, 1.0) if mismatch > 0.0 else 1.0

    @property
    def mismatched(self) -> bool:
        """Whether the model as it came is above the floor here."""
        return self.before > AT_FLOOR * self.floor

    @property
    def explained(self) -> bool:
        """Whether nothing that matters is left."""
        near = self.after <= LEFT_FLOORS * self.floor and self.fraction <= LEFT
        return self.after <= AT_FLOOR * self.floor or near


def verdict(errors: Mapping[str, JointError], findings: Sequence[object]) -> Verdict:
    """One word for errors on recordings that no fit has seen and the findings behind them."""
    if not findings:
        return "unexplained" if any(e.mismatched for e in errors.values()) else "no_mismatch"
    if all(e.explained for e in errors.values()):
        return "explained"
    return "improved"
