"""Stages of an identification: their parameters, tests and results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pytest_twin.arrays import FloatArray

StageName = Literal[
    "delay",
    "encoder",
    "gravity",
    "inertia",
    "friction",
    "drive",
    "closed_loop",
    "contact",
    "sensor",
]
State = Literal["accepted", "rejected", "reopened", "not_observable"]

STAGES: tuple[StageName, ...] = (
    "delay", "encoder", "gravity", "inertia", "friction", "drive", "closed_loop", "contact",
    "sensor",
)  # fmt: skip
"""Stages in order; the results of earlier stages are fixed in later ones."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Error of held-out recordings before and after a stage.

    Attributes:
        before, after: root mean square over joints and samples.
        unit: unit of both.
    """

    before: float
    after: float
    unit: str


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage.

    Attributes:
        why: reason of the state, one sentence.
        parameters: names of the fitted parameters.
        held_out: held-out errors, if it was tested.
        excludes: effects that could compensate for it, and how the fit prevents that.
        data: recording -> its share of the information on the stage's parameters.
    """

    name: StageName
    state: State
    why: str
    parameters: tuple[str, ...] = ()
    held_out: HeldOut | None = None
    excludes: str = ""
    data: Mapping[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Content for ``identification.json``."""
        found: dict[str, Any] = {
            "stage": self.name,
            "state": self.state,
            "why": self.why,
            "parameters": list(self.parameters),
            "excludes": self.excludes,
        }
        if self.data:
            found["data"] = dict(self.data)
        if self.held_out is not None:
            found["held_out"] = {
                "before": self.held_out.before,
                "after": self.held_out.after,
                "unit": self.held_out.unit,
            }
        return found


def in_order(stages: Sequence[Stage]) -> tuple[Stage, ...]:
    """Sort stages in the order in which they are fitted."""
    return tuple(sorted(stages, key=lambda stage: STAGES.index(stage.name)))


def shares(recordings: Sequence[str], information: FloatArray) -> dict[str, float]:
    """Return recording -> mean share of the information on several parameters.

    Args:
        recordings: name of the recording of each block of samples; names may repeat.
        information: (blocks, parameters) diagonals of the information matrices.
    """
    total = information.sum(axis=0)
    shown = total > 0.0
    if not shown.any():
        return {}
    found = dict.fromkeys(recordings, 0.0)
    for name, own in zip(recordings, information[:, shown] / total[shown], strict=True):
        found[name] += float(np.mean(own))
    return found


def judge_stage(stage: Stage, held_out: HeldOut, tolerance: float = 0.0) -> Stage:
    """Accept a stage if it does not increase the held-out error, else reject it.

    Args:
        stage: stage with its fitted parameters.
        held_out: errors of whole recordings that were not fitted.
        tolerance: relative change of such an error by chance.
    """
    better = held_out.after <= (1.0 + tolerance) * held_out.before
    change = 100.0 * (held_out.after / max(held_out.before, 1e-300) - 1.0)
    said = f"the held-out error changes by {change:+.1f} %"
    if better and change > 0.0:
        said += f", less than chance explains ({100.0 * tolerance:.1f} %): the model's value holds"
    return replace(
        stage,
        state="accepted" if better else "rejected",
        why=f"{stage.why}; {said}" if stage.why else said,
        held_out=held_out,
    )
