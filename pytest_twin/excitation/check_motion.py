"""Choose short motions along which the laws of the catalogue can be distinguished on one robot.

No motion distinguishes all laws: a gain and a torque constant act alike, and some laws are too
small within the limits. So the check is compared with all motions of the search together. What
none of them distinguishes is a group, and is no failure of the check.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.excitation.all_pairs import PairOdds
from pytest_twin.excitation.approved_robot import ApprovedRobot
from pytest_twin.excitation.candidates import whole_robot_candidates
from pytest_twin.excitation.catalogue_responses import (
    CatalogueResponses,
    OfEfforts,
    responses_of,
    terms_of,
)
from pytest_twin.excitation.excite import Excitation, state_limit, write_motions
from pytest_twin.excitation.find_safe import RejectedDesign, SafeMotion
from pytest_twin.excitation.motion import Motion
from pytest_twin.excitation.motion_search import chosen_within_limit, safe_motions, search
from pytest_twin.excitation.separate import DECIDED, noise_section
from pytest_twin.time_limit import is_over, limited, skips

NAME = "check"
LONGEST = 18.0
"""Longest motion of the check, s: short ones complement each other."""
TOGETHER = 56.0
"""Longest time of all motions of the check, s: under a minute, to be recorded at every release."""
SUFFICIENT = 0.95
"""Share of the laws that any compared motion shows, and of the pairs that any of them distinguishes
that the check must reach. Some pairs need a motion of their own."""
_SIMULATED = 6
"""Largest number of motions that are compared if each has to be simulated with every law."""


@dataclass(frozen=True)
class ChosenCheck:
    """The check.

    Attributes:
        motions: safe motions of the check, with the odds along each; none if no motion is safe.
        compared: odds along each motion that was compared.
        refused: designs without a safe motion.
    """

    motions: tuple[tuple[SafeMotion, PairOdds], ...] = ()
    compared: tuple[PairOdds, ...] = ()
    refused: tuple[RejectedDesign, ...] = ()

    @cached_property
    def check(self) -> Reached:
        """What the check shows and distinguishes."""
        return Reached.by(odds for _, odds in self.motions)

    @cached_property
    def possible(self) -> Reached:
        """What any compared motion shows and distinguishes."""
        return Reached.by(self.compared)

    @property
    def is_sufficient(self) -> bool:
        """Whether the check does nearly all that any compared motion does."""
        check, possible = self.check, self.possible
        return (
            bool(possible.laws)
            and len(check.laws) >= SUFFICIENT * len(possible.laws)
            and len(check.pairs) >= SUFFICIENT * len(possible.pairs)
        )


@dataclass(frozen=True)
class Reached:
    """Laws that at least one of some motions shows, and pairs that one of them distinguishes."""

    laws: frozenset[Term] = frozenset()
    pairs: frozenset[tuple[Term, Term]] = frozenset()

    @classmethod
    def by(cls, motions: Iterable[PairOdds]) -> Reached:
        """What some motions reach, each by its own recording."""
        reached = cls()
        for odds in motions:
            reached = reached.with_(odds)
        return reached

    def with_(self, odds: PairOdds) -> Reached:
        """What is reached with one more motion."""
        return Reached(self.laws | odds.seen, self.pairs | odds.distinguished)

    @property
    def count(self) -> int:
        """Number of laws and pairs."""
        return len(self.laws) + len(self.pairs)


def check_file(
    model: str,
    out: str,
    seed: int,
    progress: Callable[[float], None] = lambda fraction: None,
    seconds: float = 0.0,
) -> dict[str, Any]:
    """Choose the motions of the check and write them; runs in the child process.

    Args:
        model: ``twin.yaml``.
        out: folder for the motions.
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
        chosen = chosen_within_limit(
            lambda: choose(robot, terms, responses, progress), ChosenCheck()
        )
    excitation = Excitation(
        robot.realization, replace(approved, mechanisms=()), robot.noise, robot.regressor,
        robot.base, tuple(motion for motion, _ in chosen.motions), chosen.refused, (), seed,
    )  # fmt: skip
    written = write_motions(excitation, Path(model), Path(out))
    document = written["document"]
    document["check"] = _document(robot, terms, responses, chosen)
    document["verdict"] = "separable" if chosen.is_sufficient else "not_separable"
    state_limit(document, limit)
    return written


def choose(
    robot: ApprovedRobot,
    terms: Sequence[Term],
    responses: CatalogueResponses,
    progress: Callable[[float], None] = lambda fraction: None,
) -> ChosenCheck:
    """Choose safe motions that together are expected to tell most pairs of laws apart.

    The D-optimal series, reversals of all joints at once, random series and random moves are
    compared by the efforts of the laws, which need no simulation. Of these, motions that complement
    each other are chosen one after another, and then once more by all readings.

    Raises:
        OutOfTime: the time limit is over before a motion is judged.
    """
    efforts = responses if isinstance(responses, OfEfforts) else OfEfforts(robot, terms)

    def judge(motions: Sequence[Motion]) -> list[PairOdds]:
        odds = []
        for motion in motions:
            if is_over():
                raise OutOfTime
            odds.append(PairOdds.of(efforts.along(motion), DECIDED))
        return odds

    moved = range(len(robot.approved.names))
    judged = search(
        robot, whole_robot_candidates(robot), moved, judge, lambda done: progress(0.3 * done)
    )
    safe, refused = safe_motions(robot, judged)
    progress(0.5)
    judged_by_name = {one.motion.name: one for one in judged}
    if responses is not efforts:
        scores = [judged_by_name[one.motion.name].score for one in safe]
        order = _cover(scores)
        # By positions a motion may be worth more than by efforts: without others beside it, what
        # the check reaches would be compared with itself.
        others = sorted(set(range(len(safe))) - set(order), key=lambda at: -_count(scores[at]))
        safe = [safe[at] for at in [*order, *others][:_SIMULATED]]
    compared: list[PairOdds] = []
    for at, one in enumerate(safe):
        progress(0.5 + 0.4 * at / len(safe))
        if compared and skips(one.motion.name):
            break
        known = judged_by_name[one.motion.name]
        # A motion that was not safe as it was judged is a slower one now.
        if responses is efforts and np.array_equal(known.motion.position, one.motion.position):
            compared.append(known.score)
        else:
            compared.append(PairOdds.of(responses.along(one.motion), DECIDED))
    motions: list[tuple[SafeMotion, PairOdds]] = []
    seconds = 0.0
    for at in _cover(compared):
        seconds += float(safe[at].motion.time[-1])
        if seconds > TOGETHER:
            break
        name = f"{NAME}_{len(motions) + 1}"
        motions.append((replace(safe[at], motion=replace(safe[at].motion, name=name)),
                        compared[at]))  # fmt: skip
    return ChosenCheck(tuple(motions), tuple(compared), () if motions else tuple(refused))


def _count(odds: PairOdds) -> int:
    """Number of laws that a motion shows and of pairs that it distinguishes."""
    return Reached.by([odds]).count


def _cover(odds: Sequence[PairOdds]) -> list[int]:
    """Indices of motions one after another, each with the largest gain (greedy set cover).

    It ends where no motion reaches more.
    """
    order: list[int] = []
    reached = Reached()
    while len(order) < len(odds):
        with_each = [reached.with_(one) for one in odds]
        # The first of equal ones has the largest expected number.
        best = max(range(len(odds)), key=lambda at: with_each[at].count)
        if with_each[best].count == reached.count:
            break
        order.append(best)
        reached = with_each[best]
    return order


def groups_of(pairs: Iterable[tuple[Term, Term]]) -> list[tuple[Term, ...]]:
    """Group laws of which no two are distinguished; every given pair is in a group.

    Args:
        pairs: laws that are not distinguished.
    """
    left = list(dict.fromkeys(pairs))
    alike = set(left) | {(b, a) for a, b in left}
    terms = list(dict.fromkeys(term for pair in left for term in pair))
    groups = []
    while left:
        group = list(left[0])
        for term in terms:
            if term not in group and all((term, one) in alike for one in group):
                group.append(term)
        groups.append(tuple(group))
        left = [pair for pair in left if not set(pair) <= set(group)]
    return groups


def _document(
    robot: ApprovedRobot, terms: Sequence[Term], responses: CatalogueResponses, chosen: ChosenCheck
) -> dict[str, Any]:
    """Section ``check`` of ``excitation.json``."""
    joints = robot.approved.names
    order = {term: at for at, term in enumerate(terms)}
    check, possible = chosen.check, chosen.possible
    alike = {pair for one in chosen.compared for pair in one.pairs} - possible.pairs

    def names(some: Iterable[Term]) -> list[str]:
        return [name_of(term, joints) for term in sorted(some, key=order.__getitem__)]

    def pairs(some: Iterable[tuple[Term, Term]]) -> list[tuple[Term, Term]]:
        return sorted(some, key=lambda pair: (order[pair[0]], order[pair[1]]))

    return {
        "laws": len(terms),
        "showable": len(possible.laws),
        "shown": len(check.laws),
        "separable": len(possible.pairs),
        "separated": len(check.pairs),
        "needed": DECIDED,
        "sufficient": SUFFICIENT,
        **noise_section(robot, responses.noise),
        "tried": len(chosen.compared),
        "not_shown": names(possible.laws - check.laws),
        "never_shown": names(set(terms) - possible.laws),
        "not_separated": [names(pair) for pair in pairs(possible.pairs - check.pairs)],
        "groups": [names(group) for group in groups_of(pairs(alike))],
    }


def name_of(term: Term, joints: Sequence[str]) -> str:
    """Name of a law at its joint, ``EFFECT@JOINT``, or ``EFFECT`` of the whole robot."""
    return term.effect if term.joint < 0 else f"{term.effect}@{joints[term.joint]}"
