"""Motions among which one is chosen that tells hypotheses apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.excitation import d_optimal
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.approved_robot import ApprovedRobot
from pytest_twin.excitation.designs import several_joint_designs, single_joint_designs
from pytest_twin.excitation.fourier import REST
from pytest_twin.excitation.motion import Design, JointStates, Motion, Path, Role
from pytest_twin.excitation.safety import check_commands
from pytest_twin.time_limit import is_over

KIND = "moves"
_SERIES = 3
"""Number of random Fourier series of all joints."""
_MOVES = 6
"""Number of random sequences of moves."""
_SLOWEST = 0.02
"""Slowest move as a share of the approved speed: dry friction shows at low speeds."""
_REVERSED = (1.0, 0.5, 0.2, 0.1, 0.05)
"""Speeds of reversals of all joints, as shares of the fastest move."""
_REACHES = (0.2, 0.35, 0.5, 0.5)
"""Distances from the start that reversals of all joints reach, as shares of the approved range."""
_LONGEST_REST = 1.0
"""Longest rest between two moves, s."""
_MOST_MOVES = 200
"""Largest number of moves of one motion."""
_RENEWED = 0.3
"""Share of the moves that a variant draws again."""
_VARIED, _VARIANTS = 3, 4
"""Number of moves that are varied in a round, and of the variants of each."""
_SMALL = 0.3
"""Amplitude of motions that are compared if none keeps the limits with its full amplitude."""
_SPREAD = 0.2
"""Standard deviation of a changed target, relative to the approved range, and of the logarithm of a
changed speed."""


@dataclass(frozen=True)
class Moves:
    """A sequence of moves from rest to rest; it repeats until the time is over.

    Attributes:
        target: (k, j) positions as shares of the approved range.
        share: (k,) speed as a share of the fastest move.
        rest: (k,) time at rest after each move, s.
    """

    target: FloatArray
    share: FloatArray
    rest: FloatArray

    @classmethod
    def drawn(cls, random: np.random.Generator, start: FloatArray, moved: Sequence[int]) -> Moves:
        """Draw moves of some joints, either of one joint at a time or of all at once.

        Args:
            start: (j,) start as a share of the approved range.
            moved: columns of the joints that move.
        """
        count = int(random.integers(4, 13))
        together = random.random() < 0.5
        target = np.tile(start, (count, 1))
        at = start.copy()
        for k in range(count):
            columns = list(moved) if together else [moved[int(random.integers(len(moved)))]]
            at[columns] = random.uniform(0.0, 1.0, len(columns))
            target[k] = at
        share = np.exp(random.uniform(np.log(_SLOWEST), 0.0, count))
        rest = random.uniform(0.0, _LONGEST_REST, count) * (random.random(count) < 0.5)
        return cls(target, share, rest)

    @classmethod
    def reversals(cls, random: np.random.Generator, start: FloatArray, reach: float) -> Moves:
        """Reversals of all joints at once about the start; slower ones are smaller.

        Args:
            start: (j,) start as a share of the approved range.
            reach: largest distance from the start, as a share of the approved range.
        """
        signs = random.choice((-1.0, 1.0), len(start))
        share = np.repeat(_REVERSED, 2)
        side = np.tile((1.0, -1.0), len(_REVERSED))
        target = np.clip(start + reach * (share * side)[:, None] * signs, 0.0, 1.0)
        return cls(target, share, np.zeros(len(share)))

    def varied(self, random: np.random.Generator, moved: Sequence[int]) -> Moves:
        """Return the moves with some targets, speeds and rests changed."""
        count = len(self.share)
        new = random.random(count) < _RENEWED
        new[int(random.integers(count))] = True
        target, share = self.target.copy(), self.share.copy()
        step = np.zeros_like(target)
        step[:, list(moved)] = random.normal(0.0, _SPREAD, (count, len(moved)))
        target[new] = np.clip(target + step, 0.0, 1.0)[new]
        share[new] = np.clip(share * np.exp(random.normal(0.0, 3.0 * _SPREAD, count)),
                             _SLOWEST, 1.0)[new]  # fmt: skip
        rest = np.where(
            new & (random.random(count) < 0.5), random.uniform(0.0, _LONGEST_REST, count), self.rest
        )
        return Moves(target, share, rest)

    def states(self, approved: ApprovedLimits, scale: float) -> JointStates:
        """Return the motion that repeats the moves within the approved time, then goes back."""
        lower, upper = approved.room
        start = approved.start
        path = Path(start, approved.speed, approved.acceleration, approved.rate)
        path.dwell(REST)
        for k in range(_MOST_MOVES):
            i = k % len(self.share)
            place = lower + self.target[i] * (upper - lower)
            target, share = start + scale * (place - start), float(self.share[i])
            away = Path(target, approved.speed, approved.acceleration, approved.rate)
            needed = path.time_to(target) / share + float(self.rest[i]) + away.time_to(start)
            if path.seconds + needed + 2.0 * REST > approved.duration:
                if k < len(self.share):
                    continue
                break
            path.move(target, share)
            path.dwell(float(self.rest[i]))
        path.move(start)
        path.dwell(REST)
        return path.states()


@dataclass(frozen=True)
class Candidate:
    """A design, with the moves that it consists of if it can be varied."""

    design: Design
    moves: Moves | None = None


def candidates(
    approved: ApprovedLimits,
    loads: Sequence[Sequence[FloatArray]],
    optimal: d_optimal.Design,
    moved: Sequence[int],
    seed: int,
) -> list[Candidate]:
    """Return single-joint motions of some joints, random series, and random moves.

    Args:
        loads: for each joint, poses (j,) with different loads on it.
        optimal: the functions of the series.
        moved: columns of the joints that the hypotheses are about.
        seed: seed of all random choices.
    """
    asked = replace(approved, mechanisms=("delay", "closed_loop", "friction"))
    names = {approved.names[i] for i in moved}
    found = [
        Candidate(replace(design, mechanisms=()))
        for design in single_joint_designs(asked, loads, seed)
        if design.role == "fit" and names.issuperset(design.moved)
    ]
    for number in range(_SERIES):
        coefficients = optimal.random(1000 * seed + number)
        found.append(
            Candidate(_design(f"fourier_{number + 1}", "fourier", approved.names,
                              lambda scale, seed, c=coefficients: optimal.drawn(c, scale), seed))
        )  # fmt: skip
    random = np.random.default_rng(seed)
    start = _start(approved)
    for number in range(_MOVES):
        which = list(moved) if number % 2 == 0 else range(len(approved.names))
        moves = Moves.drawn(random, start, list(which))
        found.append(of_moves(f"{KIND}_{number + 1}", approved, moves, seed))
    return found


def whole_robot_candidates(robot: ApprovedRobot) -> list[Candidate]:
    """Return motions of all joints: the D-optimal series, reversals, random series and moves.

    A joint at rest would show its laws only by what little the others move it.
    """
    approved, seed = robot.approved, robot.seed
    random = np.random.default_rng(seed)
    series = several_joint_designs(
        replace(approved, mechanisms=("inertia",)), robot.regressor, robot.noise.effort,
        robot.around, (), robot.optimal, seed,
    )  # fmt: skip
    found = [Candidate(replace(one, mechanisms=())) for one in series if one.role == "fit"]
    start = _start(approved)
    for number, reach in enumerate(_REACHES):
        moves = Moves.reversals(random, start, reach)
        found.append(of_moves(f"{KIND}_reversals_{number + 1}", approved, moves, seed))
    moved = range(len(approved.names))
    found += candidates(approved, robot.loads, robot.optimal, moved, seed)
    return [one for one in found if set(one.design.moved) == set(approved.names)]


def _start(approved: ApprovedLimits) -> FloatArray:
    """(j,) start as a share of the approved range."""
    lower, upper = approved.room
    return np.asarray((approved.start - lower) / (upper - lower))


def varied(
    best: Sequence[Candidate],
    approved: ApprovedLimits,
    moved: Sequence[int],
    random: np.random.Generator,
    number: int,
    seed: int,
) -> list[Candidate]:
    """Return variants of the best moves so far.

    Args:
        best: candidates, the best first.
        moved: columns of the joints whose targets are changed.
        number: number of the round, for the names.
    """
    parents = [one.moves for one in best if one.moves is not None][:_VARIED]
    return [
        of_moves(
            f"{KIND}_{number + 2}_{i + 1}_{k + 1}", approved, parent.varied(random, moved), seed
        )
        for i, parent in enumerate(parents)
        for k in range(_VARIANTS)
    ]


def within_commands(
    some: Sequence[Candidate], robot: ApprovedRobot
) -> tuple[list[Candidate], list[Motion]]:
    """Return the candidates whose commands keep the limits, and their motions.

    If there is none, smaller motions of all candidates: these may be safe.

    Raises:
        OutOfTime: the time limit is over.
    """
    kept, motions = [], []
    for candidate in some:
        if is_over():
            raise OutOfTime
        motion = candidate.design.motion(1.0, candidate.design.seed)
        if check_commands(motion, robot.approved, robot.around).is_safe:
            kept.append(candidate)
            motions.append(motion)
    if not kept:
        return list(some), [one.design.motion(_SMALL, one.design.seed) for one in some]
    return kept, motions


def of_moves(name: str, approved: ApprovedLimits, moves: Moves, seed: int) -> Candidate:
    """Return the candidate that consists of some moves."""
    changed = np.any(np.ptp(moves.target, axis=0, keepdims=True) > 0.0, axis=0)
    which = tuple(joint for joint, one in zip(approved.names, changed, strict=True) if one)
    return Candidate(
        _design(name, KIND, which or approved.names,
                lambda scale, seed: moves.states(approved, scale), seed),
        moves,
    )  # fmt: skip


def _design(name: str, kind: str, moved: tuple[str, ...], make: object, seed: int) -> Design:
    role: Role = "fit"
    return Design(name, (), kind, role, moved, make, seed)  # type: ignore[arg-type]
