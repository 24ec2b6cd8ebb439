"""How a target expresses an effect of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pytest_twin.asset.loss.matrix import Verdict


@dataclass(frozen=True, slots=True)
class Expression:
    """One effect as a target expresses it.

    Attributes:
        effect, joint: id and joint; joint None for an effect of the whole robot.
        values: parameter -> value, SI units.
        verdict: ``kept`` if the target has the law, ``changed`` if it has a part or an
            approximation of it, ``lost`` otherwise.
        written: elements of the target that hold it; empty where it is lost.
        why: what is missing and why; empty where it is kept.
    """

    effect: str
    joint: str | None
    values: Mapping[str, float]
    verdict: Verdict
    written: str = ""
    why: str = ""

    @property
    def place(self) -> tuple[str, str | None]:
        """Effect and joint."""
        return self.effect, self.joint

    @property
    def words(self) -> str:
        """Effect and joint as text."""
        return self.effect if self.joint is None else f"{self.effect} of {self.joint}"
