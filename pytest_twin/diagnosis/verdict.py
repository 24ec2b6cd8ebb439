"""What the numbers amount to, in one word."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

Verdict = Literal["no_mismatch", "explained", "improved", "unexplained"]

AT_FLOOR = 3.0
"""Root mean square up to this many floors is at the floor: it is an estimate itself, and a real
joint's micro-slip and a simulator's contact law leave a few of it."""
STANDS_OUT = 1.5
"""A signal up to this many floors holds nothing that could be named."""
UNSEEN = 1e6
"""The floor, rad or m, of a joint whose encoder says nothing."""
LEFT = 0.02
"""Share of the squared mismatch that may be left and still count as explained, ..."""
LEFT_FLOORS = 10.0
"""... up to this many floors: a large mismatch leaves a large remainder, which is one."""

# A name must take away this share of what still stands above the floor at some joint, and this
# share of what the nominal model left there, of so many floors at most: less is the simulator's own
# imperfection.
_SHARE_OF_REST = 0.1
_SHARE_OF_ALL, _MOST_FLOORS = 0.003, 100.0


def worth_a_name(
    floor: FloatArray, before: FloatArray, after: FloatArray, whole: FloatArray
) -> bool:
    """Whether some signal falls by enough for a name to have made it fall.

    Not by what would not stand out of the floor alone: no name is claimed for that in the end.

    Args:
        floor: (signals,) deviations that need no explanation.
        before, after: (signals,) mean squares without the name and with it.
        whole: the same of the model as it came.
    """
    square = floor**2
    gone = before - after
    rest = np.maximum(before - square, 0.2 * square)
    all_of_it = np.clip(whole - square, 0.2 * square, _MOST_FLOORS**2 * square)
    alone = (STANDS_OUT**2 - 1.0) * square
    least = np.maximum.reduce([alone, _SHARE_OF_REST * rest, _SHARE_OF_ALL * all_of_it])
    return bool((gone >= least).any())


def own_mismatch(
    floor: FloatArray, whole: FloatArray, left: FloatArray, acting: NDArray[np.bool_]
) -> FloatArray:
    """(signals,) mean square of the model as it came that laws which are a little off may have left
    a part of.

    A law that is off shows where it acts. Where none acts, what comes from there through the bodies
    is no greater share of the mismatch than what is left there.

    Args:
        floor: (signals,) deviations that need no explanation.
        whole: (signals,) mean squares of the model as it came.
        left: the same with all that is named.
        acting: (signals,) where something that is named acts.
    """
    if not acting.any():
        return whole
    square = floor**2
    shares = np.maximum(left, square) / np.maximum(whole, square)
    elsewhere = min(float(np.max(shares[acting])) / _SHARE_OF_ALL, 1.0)
    return np.where(acting, whole, elsewhere * whole)


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
