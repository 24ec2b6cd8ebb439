"""The verdict of a diagnosis, and the thresholds on residuals behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

Verdict = Literal["no_mismatch", "explained", "improved", "unexplained"]

AT_FLOOR = 3.0
"""An RMS residual of up to this many floors counts as noise. The floor is an estimate, and
micro-slip of real joints and MuJoCo's soft contacts leave residuals of 2 to 3 floors."""
STANDS_OUT = 1.5
"""A signal below this many floors contains no identifiable effect."""
UNSEEN = 1e6
"""Floor in rad or m of a joint whose encoder gives no information, so that it has no weight."""
LEFT = 0.02
"""A residual of up to this share of the squared error counts as explained, ..."""
LEFT_FLOORS = 10.0
"""... if it is also below this many floors: above, it is a mismatch of its own."""
OF_TRAVEL = 1e-3
"""An error of up to this share of a joint's travel is of no consequence where small corrections of
the model explain it: 1 mrad of 1 rad is at the repeatability of ordinary arms."""

# Least share of the remaining squared error above the floor, and of the nominal model's squared
# error (counted up to so many floors), that an effect must remove at some joint. Less is within the
# accuracy of the simulation.
_SHARE_OF_REST = 0.1
_SHARE_OF_ALL, _MOST_FLOORS = 0.003, 100.0


def worth_a_name(
    floor: FloatArray, before: FloatArray, after: FloatArray, whole: FloatArray
) -> bool:
    """Whether an effect reduces the error of at least one signal enough to be accepted.

    Args:
        floor: (signals,) noise floor.
        before, after: (signals,) mean squared residuals without and with the effect.
        whole: (signals,) mean squared residuals of the nominal model.
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
    """(signals,) part of the nominal squared error of which an inexact effect may leave a residual.

    An inexact effect leaves a residual where it acts. At other joints it leaves at most the same
    share of the error, because it reaches them only through the mechanism.

    Args:
        floor: (signals,) noise floor.
        whole: (signals,) mean squared residuals of the nominal model.
        left: (signals,) mean squared residuals with all accepted effects.
        acting: (signals,) whether an accepted effect acts there.
    """
    if not acting.any():
        return whole
    square = floor**2
    shares = np.maximum(left, square) / np.maximum(whole, square)
    elsewhere = min(float(np.max(shares[acting])) / _SHARE_OF_ALL, 1.0)
    return np.where(acting, whole, elsewhere * whole)


@dataclass(frozen=True, slots=True)
class JointError:
    """RMS prediction error of one joint in ``unit``.

    Attributes:
        before: of the nominal model.
        after: of the model with the findings.
        floor: noise floor (sensor noise, sample timing, discretization).
        unit: rad or m.
        travel: distance between the joint's ends in the recordings; 0 if unknown.
    """

    before: float
    after: float
    floor: float
    unit: str
    travel: float = 0.0

    @property
    def fraction(self) -> float:
        """Remaining share of the squared error above the floor."""
        mismatch = self.before**2 - self.floor**2
        left = self.after**2 - self.floor**2
        if left <= 0.0:
            return 0.0
        return min(left / mismatch, 1.0) if mismatch > 0.0 else 1.0

    @property
    def mismatched(self) -> bool:
        """Whether the nominal model's error is above the floor."""
        return self.before > AT_FLOOR * self.floor

    @property
    def inconsequential(self) -> bool:
        """Whether the nominal model's error is at the floor, or small against the travel."""
        return not self.mismatched or self.before <= OF_TRAVEL * self.travel

    @property
    def explained(self) -> bool:
        """Whether the residual is at the floor, or small enough in both measures."""
        near = self.after <= LEFT_FLOORS * self.floor and self.fraction <= LEFT
        return self.after <= AT_FLOOR * self.floor or near


class Reported(Protocol):
    """What a verdict reads of a finding."""

    @property
    def small(self) -> str:
        """Why it is a small correction; empty for a finding."""


def verdict(errors: Mapping[str, JointError], findings: Sequence[Reported]) -> Verdict:
    """The verdict from held-out errors and findings.

    With small corrections alone there is no mismatch where the nominal model's errors are at the
    noise floor or, against the travel of the joints, of no consequence.
    """
    mismatched = any(e.mismatched for e in errors.values())
    if not findings:
        return "unexplained" if mismatched else "no_mismatch"
    if all(f.small for f in findings) and all(e.inconsequential for e in errors.values()):
        return "no_mismatch"
    if all(e.explained for e in errors.values()):
        return "explained"
    return "unexplained" if all(f.small for f in findings) else "improved"
