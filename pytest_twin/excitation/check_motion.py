"""Choose a short motion along which the laws of the catalogue can be distinguished on one robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.estimation.deadline import OutOfTime, ending_at_limit
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.excitation.all_pairs import PairOdds, probability
from pytest_twin.excitation.approved_robot import ApprovedRobot
from pytest_twin.excitation.candidates import (
    Candidate,
    varied,
    whole_robot_candidates,
    within_commands,
)
from pytest_twin.excitation.catalogue_responses import (
    CatalogueResponses,
    OfEfforts,
    responses_of,
    terms_of,
)
from pytest_twin.excitation.excite import Excitation, write_motions
from pytest_twin.excitation.find_safe import RejectedDesign, Robot, SafeMotion, find_safe
from pytest_twin.excitation.motion import Motion
from pytest_twin.excitation.separate import DECIDED, noise_section
from pytest_twin.time_limit import is_over, limited, skips

NAME = "check"
LONGEST = 30.0
"""Longest check motion, s: short, so that it is repeated at every release."""
_ROUNDS = 3
"""Number of rounds in which the best random moves are varied."""
_FINALISTS = 4
"""Number of motions that are simulated with every law, the best by efforts first."""


@dataclass(frozen=True)
class Judged:
    """A candidate with its motion and the odds of all laws along it."""

    candidate: Candidate
    motion: Motion
    odds: PairOdds


@dataclass(frozen=True)
class Chosen:
    """The check motion.

    Attributes:
        safe: the motion with its odds; None if none is safe.
        refused: designs without a safe motion.
        tried: number of motions that were compared.
    """

    safe: tuple[SafeMotion, PairOdds] | None = None
    refused: tuple[RejectedDesign, ...] = ()
    tried: int = 0


def check_file(
    model: str,
    out: str,
    seed: int,
    progress: Callable[[float], None] = lambda fraction: None,
    seconds: float = 0.0,
) -> dict[str, Any]:
    """Choose the check motion and write it; runs in the child process.

    Args:
        model: ``twin.yaml``.
        out: folder for the motion.
        seed, progress, seconds: as for :func:`~pytest_twin.excitation.excite.excite_file`.

    Returns:
        ``document``, ``abort`` and ``drawn`` as of ``excite_file``.
    """
    with limited(seconds) as limit:
        robot = ApprovedRobot.load(Path(model), seed)
        approved = robot.approved
        robot = replace(robot, approved=replace(approved, duration=min(approved.duration, LONGEST)))
        terms = terms_of(robot)
        responses = responses_of(robot, terms)
        with ending_at_limit():
            try:
                chosen = choose(robot, terms, responses, progress)
            except OutOfTime:
                skips("all motions")
                chosen = Chosen()
    safe = () if chosen.safe is None else (chosen.safe[0],)
    excitation = Excitation(
        robot.realization, replace(approved, mechanisms=()), robot.noise, robot.regressor,
        robot.base, safe, () if safe else chosen.refused, (), seed,
    )  # fmt: skip
    written = write_motions(excitation, Path(model), Path(out))
    section = _document(robot, terms, responses, chosen)
    document = written["document"]
    document["check"] = section
    is_complete = bool(safe) and not section["not_shown"] and not section["not_separated"]
    document["verdict"] = "separable" if is_complete else "not_separable"
    document["not_tried"] = limit.not_tried
    document["ended_early"] = limit.note()
    return written


def choose(
    robot: ApprovedRobot,
    terms: Sequence[Term],
    responses: CatalogueResponses,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Chosen:
    """Choose the safe motion that is expected to tell most pairs of laws apart.

    The D-optimal series, reversals of all joints at once, random series and random moves are
    compared by the efforts of the laws; then the best moves are varied, as in an evolution
    strategy. These efforts need no simulation.
    The best safe motions are compared by all readings.

    Raises:
        OutOfTime: the time limit is over before a motion is judged.
    """
    efforts = OfEfforts(robot, terms)
    moved = range(len(robot.approved.names))
    judged = _judged(whole_robot_candidates(robot), robot, efforts)
    random = np.random.default_rng(robot.seed)
    for number in range(_ROUNDS):
        progress(0.1 * (1 + number))
        if skips("varied motions"):
            break
        best = [one.candidate for one in judged]
        try:
            some = varied(best, robot.approved, moved, random, number, robot.seed)
            judged += _judged(some, robot, efforts)
        except OutOfTime:
            skips("varied motions")
            break
        judged.sort(key=lambda one: one.odds.rank, reverse=True)
    robots: dict[str | None, Robot] = {None: Robot(robot.realization, robot.approved)}
    finalists = [one.candidate.design for one in judged[:_FINALISTS]]
    safe, refused = find_safe(finalists, robot.approved, robots, lambda fraction: None)
    final: list[tuple[SafeMotion, PairOdds]] = []
    for at, one in enumerate(safe):
        progress(0.4 + 0.5 * at / len(safe))
        if final and skips(one.motion.name):
            break
        final.append((one, PairOdds.of(responses.along(one.motion), DECIDED)))
    if not final:
        return Chosen(None, tuple(refused), len(judged))
    motion, odds = max(final, key=lambda one: one[1].rank)
    named = replace(motion, motion=replace(motion.motion, name=NAME))
    return Chosen((named, odds), (), len(judged))


def _judged(
    some: Sequence[Candidate], robot: ApprovedRobot, responses: CatalogueResponses
) -> list[Judged]:
    """Candidates whose commands keep the limits, the best first.

    Raises:
        OutOfTime: the time limit is over.
    """
    judged: list[Judged] = []
    for candidate, motion in zip(*within_commands(some, robot), strict=True):
        if is_over():
            raise OutOfTime
        judged.append(Judged(candidate, motion, PairOdds.of(responses.along(motion), DECIDED)))
    return sorted(judged, key=lambda one: one.odds.rank, reverse=True)


def _document(
    robot: ApprovedRobot, terms: Sequence[Term], responses: CatalogueResponses, chosen: Chosen
) -> dict[str, Any]:
    """Section ``check`` of ``excitation.json``."""
    names = robot.approved.names
    odds = None if chosen.safe is None else chosen.safe[1]
    shown = {} if odds is None else dict(odds.shown)
    pairs = {} if odds is None else dict(odds.pairs)
    weak = [term for term in terms if probability(shown.get(term, 0.0)) < DECIDED]
    alike = sorted(
        (pair for pair, one in pairs.items() if probability(one) < DECIDED),
        key=lambda pair: pairs[pair],
    )
    return {
        "laws": len(terms),
        "pairs": len(pairs),
        "separated": 0 if odds is None else odds.separated,
        "needed": DECIDED,
        **noise_section(robot, responses.noise),
        "tried": chosen.tried,
        "not_shown": [
            {"name": name_of(term, names), "log_odds": _rounded(shown.get(term))} for term in weak
        ],
        "not_separated": [
            {
                "names": [name_of(term, names) for term in pair],
                "probability": round(probability(pairs[pair]), 4),
                "log_odds": _rounded(pairs[pair]),
            }
            for pair in alike
        ],
    }


def name_of(term: Term, joints: Sequence[str]) -> str:
    """Name of a law at its joint, ``EFFECT@JOINT``, or ``EFFECT`` of the whole robot."""
    return term.effect if term.joint < 0 else f"{term.effect}@{joints[term.joint]}"


def _rounded(log_odds: float | None) -> float | None:
    return None if log_odds is None else round(log_odds, 2)
