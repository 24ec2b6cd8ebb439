"""Search for safe motions with a high score: candidates, then variants of the best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from pytest_twin.estimation.deadline import OutOfTime, ending_at_limit
from pytest_twin.excitation.approved_robot import ApprovedRobot
from pytest_twin.excitation.candidates import Candidate, varied, within_commands
from pytest_twin.excitation.find_safe import RejectedDesign, Robot, SafeMotion, find_safe
from pytest_twin.excitation.motion import Motion
from pytest_twin.time_limit import skips

_ROUNDS = 3
"""Number of rounds in which the best random moves are varied."""


class Ranked(Protocol):
    """A score of a motion; a larger rank is better."""

    @property
    def rank(self) -> Any:
        """Comparable value."""


Choice = TypeVar("Choice")
Score = TypeVar("Score", bound=Ranked)
Judge = Callable[[Sequence[Motion]], Sequence[Score]]


@dataclass(frozen=True)
class Judged(Generic[Score]):
    """A candidate whose commands keep the limits, with its motion and score."""

    candidate: Candidate
    motion: Motion
    score: Score


def chosen_within_limit(choose: Callable[[], Choice], none: Choice) -> Choice:
    """The choice of motions; ``none`` where the time limit ends it before the first is judged."""
    with ending_at_limit():
        try:
            return choose()
        except OutOfTime:
            skips("all motions")
            return none


def search(
    robot: ApprovedRobot,
    first: Sequence[Candidate],
    moved: Sequence[int],
    judge: Judge[Score],
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[Judged[Score]]:
    """Score candidates, vary the best moves as in an evolution strategy; return all, best first.

    Args:
        moved: columns of the joints whose targets are varied.
        judge: returns the score of each motion.

    Raises:
        OutOfTime: the time limit is over before the first motions are compared.
    """
    judged = _scored(first, robot, judge)
    random = np.random.default_rng(robot.seed)
    for number in range(_ROUNDS):
        progress((1 + number) / (1 + _ROUNDS))
        if skips("varied motions"):
            break
        best = [one.candidate for one in judged]
        try:
            variants = varied(best, robot.approved, moved, random, number, robot.seed)
            judged += _scored(variants, robot, judge)
        except OutOfTime:
            skips("varied motions")
            break
        judged.sort(key=lambda one: one.score.rank, reverse=True)
    return judged


def safe_motions(
    robot: ApprovedRobot, finalists: Sequence[Judged[Score]]
) -> tuple[list[SafeMotion], list[RejectedDesign]]:
    """Return the safe motions of some candidates by simulation, and designs without one."""
    robots: dict[str | None, Robot] = {None: Robot(robot.realization, robot.approved)}
    designs = [one.candidate.design for one in finalists]
    return find_safe(designs, robot.approved, robots, lambda fraction: None)


def _scored(
    some: Sequence[Candidate], robot: ApprovedRobot, judge: Judge[Score]
) -> list[Judged[Score]]:
    candidates, motions = within_commands(some, robot)
    judged = [Judged(*each) for each in zip(candidates, motions, judge(motions), strict=True)]
    return sorted(judged, key=lambda one: one.score.rank, reverse=True)
