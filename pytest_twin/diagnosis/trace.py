"""The record of a search: what was proposed, its score, and why it was accepted or rejected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pytest_twin.diagnosis.hypothesis import Hypothesis, Term

Decision = Literal["accepted", "rejected", "shortlisted", "started", "ended"]
MOST_STEPS = 2000
"""Steps that are kept; a diagnosis of six joints takes some hundred."""


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a search.

    Attributes:
        stage: what the search works on, ``whole recordings``.
        move: what kind of change was proposed, ``addition``.
        proposed: effects with their joints, ``viscous_friction at elbow``; all of the proposal.
        score: of the proposal, above the nominal model's; None where none was computed.
        best: effects of the best model so far.
        best_score: its score, above the nominal model's.
        decision: what became of the proposal.
        reason: why, in one sentence.
        simulations: of all data, taken so far by the whole diagnosis.
        seconds: since the diagnosis began.
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
        """As ``diagnosis.json`` has it."""
        return {
            "stage": self.stage,
            "move": self.move,
            "proposed": list(self.proposed),
            "score": _rounded(self.score),
            "best": list(self.best),
            "best_score": _rounded(self.best_score),
            "decision": self.decision,
            "reason": self.reason,
            "simulations": round(self.simulations, 1),
        }


def _rounded(score: float | None) -> float | None:
    return None if score is None or not np.isfinite(score) else round(float(score), 2)


class Trace:
    """Steps of all searches of a diagnosis, in order.

    Args:
        listeners: called with each step.

    Attributes:
        stage: what is searched now.
        steps: the first ``MOST_STEPS``.
        left_out: how many came after these.
    """

    def __init__(self, *listeners: Callable[[Step], None]) -> None:
        self.listeners = [*listeners]
        self.stage = "whole recordings"
        self.steps: list[Step] = []
        self.left_out = 0

    def add(self, step: Step) -> None:
        """Keep a step, or count it where there are too many."""
        if len(self.steps) < MOST_STEPS:
            self.steps.append(step)
        else:
            self.left_out += 1
        for listener in self.listeners:
            listener(step)

    def to_json(self) -> dict[str, Any]:
        """``search_trace`` of ``diagnosis.json``."""
        return {"steps": [s.to_json() for s in self.steps], "left_out": self.left_out}


def named(joints: Sequence[str], terms: Sequence[Term]) -> tuple[str, ...]:
    """Effects with their joints, as a step has them."""
    return tuple(t.effect if t.joint < 0 else f"{t.effect} at {joints[t.joint]}" for t in terms)


def in_words(joints: Sequence[str], hypothesis: Hypothesis) -> str:
    """Effects of a hypothesis, ``the nominal model`` where it has none."""
    return ", ".join(named(joints, hypothesis.terms)) or "the nominal model"
