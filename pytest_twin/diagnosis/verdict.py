"""The verdict of a diagnosis, and the thresholds on residuals behind it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from pytest_twin.diagnosis.verdict_settings import VERDICT

Verdict = Literal["no_mismatch", "explained", "improved", "unexplained"]

UNSEEN = 1e6
"""Floor in rad or m of a joint whose encoder gives no information, so that it has no weight."""


@dataclass(frozen=True, slots=True)
class JointError:
    """RMS prediction error of one joint in ``unit``.

    Attributes:
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
    def unexplained_log_share(self) -> float:
        """Remaining share of the log-likelihood between the nominal model and the noise floor."""
        if self.is_at_floor:
            return 0.0
        if self.after >= self.before:
            return 1.0
        return math.log(self.after / self.floor) / math.log(self.before / self.floor)

    @property
    def is_mismatched(self) -> bool:
        """Whether the nominal model's error is above the floor."""
        return self.before > VERDICT.at_floor * self.floor

    @property
    def is_inconsequential(self) -> bool:
        """Whether the nominal model's error is at the floor, or small against the travel."""
        return not self.is_mismatched or self.before <= VERDICT.of_travel * self.travel

    @property
    def is_at_floor(self) -> bool:
        """Whether the residual of the model with the findings is at the floor."""
        return self.after <= VERDICT.at_floor * self.floor

    @property
    def is_explained(self) -> bool:
        """Whether the search may end: the residual is at the floor, or small in both measures."""
        near = self.after <= VERDICT.left_floors * self.floor and self.fraction <= VERDICT.left
        return self.is_at_floor or near


class Reported(Protocol):
    """The part of a finding that the verdict needs."""

    @property
    def small(self) -> str:
        """Why it is a small correction; empty for a finding."""


def verdict(errors: Mapping[str, JointError], findings: Sequence[Reported]) -> Verdict:
    """The verdict from held-out errors and findings.

    If all findings are small corrections, the verdict can be ``no_mismatch``. This requires that
    every error of the nominal model is at the noise floor, or small against the joint's travel.

    Args:
        errors: joint -> held-out errors before and after the findings.
    """
    mismatched = any(e.is_mismatched for e in errors.values())
    if not findings:
        return "unexplained" if mismatched else "no_mismatch"
    if all(f.small for f in findings) and all(e.is_inconsequential for e in errors.values()):
        return "no_mismatch"
    if all(e.is_explained for e in errors.values()):
        return "explained"
    return "unexplained" if all(f.small for f in findings) else "improved"


def stated_verdict(of_search: Verdict, errors: Mapping[str, JointError]) -> Verdict:
    """The verdict that a reader gets, which is stricter than the rule by which a search ends.

    ``explained`` says that nothing is left to explain. That is known only at the noise floor: a
    wrong effect often removes 98 % of the squared error and leaves several floors.

    Args:
        of_search: result of :func:`verdict` for the same errors.
        errors: joint -> held-out errors before and after the findings.
    """
    if of_search == "explained" and not all(e.is_at_floor for e in errors.values()):
        return "improved"
    return of_search
