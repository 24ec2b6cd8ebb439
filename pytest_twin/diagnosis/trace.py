"""The trace of a search: each proposal, its score, and why it was accepted or rejected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pytest_twin.estimation.hypothesis import Term

Decision = Literal["accepted", "rejected", "ended"]
MOST_STEPS = 2000
"""Largest number of steps that are kept; a diagnosis of six joints has several hundred."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a search.

    Attributes:
        stage: data of the search, for example ``whole recordings``.
        move: kind of the proposed change, for example ``addition``.
        proposed: all effects of the proposal, for example ``viscous_friction at elbow``.
        score: score of the proposal minus that of the nominal model; None if it was not computed.
        best: effects of the best model so far.
        best_score: score of the best model minus that of the nominal model.
        reason: reason of the decision, in one sentence.
        simulations: simulations of all data so far, in the whole diagnosis.
        seconds: time since the diagnosis began, s.
    """

    stage: str
    move: str
    proposed: tuple[str, ...]
    score: float | None
    best: tuple[str, ...]
    best_score: float | None
    decision: Decision
    reason: str
    simulations: float
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """The step as an object of ``diagnosis.json``."""
        return {
            "stage": self.stage,
            "move": self.move,
            "proposed": list(self.proposed),
            "score": _round_score(self.score),
            "best": list(self.best),
            "best_score": _round_score(self.best_score),
            "decision": self.decision,
            "reason": self.reason,
            "simulations": round(self.simulations, 1),
        }


def _round_score(score: float | None) -> float | None:
    return None if score is None or not np.isfinite(score) else round(float(score), 2)


class Trace:
    """Steps of all searches of a diagnosis, in order.

    Args:
        listeners: called with each step.

    Attributes:
        stage: data of the present search.
        steps: the first ``MOST_STEPS`` steps.
        left_out: number of later steps, which are not kept.
    """

    def __init__(self, *listeners: Callable[[Step], None]) -> None:
        self.listeners = [*listeners]
        self.stage = "whole recordings"
        self.steps: list[Step] = []
        self.left_out = 0

    def add(self, step: Step) -> None:
        """Keep a step, or only count it after ``MOST_STEPS``; call the listeners."""
        if len(self.steps) < MOST_STEPS:
            self.steps.append(step)
        else:
            self.left_out += 1
        for listener in self.listeners:
            listener(step)

    def to_json(self) -> dict[str, Any]:
        """``search_trace`` of ``diagnosis.json``."""
        return {"steps": [s.to_json() for s in self.steps], "left_out": self.left_out}


def effect_names(joints: Sequence[str], terms: Sequence[Term]) -> tuple[str, ...]:
    """Names of effects with their joints, for example ``viscous_friction at elbow``."""
    return tuple(t.effect if t.joint < 0 else f"{t.effect} at {joints[t.joint]}" for t in terms)
