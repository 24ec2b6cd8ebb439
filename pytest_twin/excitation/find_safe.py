"""Find motions within all approved limits by scaling down or drawing again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.clearance import ClearanceChecker
from pytest_twin.excitation.closed_loop import WORSE, ClosedLoop, Response
from pytest_twin.excitation.motion import Design, Motion
from pytest_twin.excitation.safety import Verdict, check_commands, check_simulation, reasons
from pytest_twin.realization.model import Realization
from pytest_twin.time_limit import is_over, skips

_FIRST_SCALES = (1.0, 0.9, 0.75, 0.6)
"""Scales of the amplitude that are tried with each seed."""
_LAST_SCALES = (0.45, 0.3, 0.2, 0.1)
"""Scales that are tried if none of the first is safe."""
_DRAWN_AGAIN = 2
"""Number of new draws of a motion of several joints before it is scaled far down."""
_SEVERAL_JOINTS = frozenset({"grid", "fourier"})
_SEED_STEP = 1000
"""Difference of the seeds of two draws."""


@dataclass(frozen=True, slots=True)
class SafeMotion:
    """A motion within all limits.

    Attributes:
        verdict: all limits with their worst values, for commands and simulations.
        response: response of the nominal model.
    """

    motion: Motion
    verdict: Verdict
    response: Response


@dataclass(frozen=True, slots=True)
class RejectedDesign:
    """A design without a safe motion.

    Attributes:
        attempts: number of motions that were tested.
        why: limits that the last attempt exceeded.
    """

    design: Design
    attempts: int
    why: tuple[str, ...]


class Robot:
    """Nominal model and worse model (see ``WORSE``) of a robot with one payload.

    Args:
        realization: the model, with the payload.
    """

    def __init__(self, realization: Realization, approved: ApprovedLimits) -> None:
        self.around = ClearanceChecker(realization, approved)
        self.nominal = ClosedLoop(realization, approved)
        self.worse = ClosedLoop(realization, approved, WORSE)


def find_safe(
    designs: Sequence[Design],
    approved: ApprovedLimits,
    robots: Mapping[str | None, Robot],
    progress: Callable[[float], None],
) -> tuple[list[SafeMotion], list[RejectedDesign]]:
    """Find the largest safe motion of each design, or the reason why there is none.

    At the time limit no more motions are tried; those that were found are kept.

    Args:
        robots: payload -> the robot with it.
        progress: called with the fraction done.

    Returns:
        Safe motions and refused designs, in the order of the designs.
    """
    safe: dict[int, SafeMotion] = {}
    broken: dict[int, tuple[int, tuple[str, ...]]] = {}
    attempts = {at: _attempts(design) for at, design in enumerate(designs)}
    open_ = list(range(len(designs)))
    total = max(len(designs), 1)
    round_ = 0
    while open_:
        tried: dict[int, tuple[Motion, Verdict]] = {}
        for at in open_:
            if skips(designs[at].name):
                broken.setdefault(at, (0, ("not tried: the command ended early",)))
                continue
            scale, seed = attempts[at][round_]
            motion = designs[at].motion(scale, seed)
            verdict = check_commands(motion, approved, robots[motion.payload].around)
            if verdict.is_safe:
                tried[at] = (motion, verdict)
            else:
                broken[at] = (round_ + 1, tuple(reasons([verdict])))
        for at, one in _simulate_and_check(tried, approved, robots).items():
            if one.verdict.is_safe:
                safe[at] = one
            else:
                broken[at] = (round_ + 1, tuple(reasons([one.verdict])))
        round_ += 1
        open_ = [
            at for at in open_
            if at not in safe and round_ < len(attempts[at]) and not is_over()
        ]  # fmt: skip
        progress(1.0 - len(open_) / total)
    if is_over():
        for at in range(len(designs)):
            if at not in safe and broken[at][0] < len(attempts[at]):
                skips(designs[at].name)
    refused = [
        RejectedDesign(design, *broken[at]) for at, design in enumerate(designs) if at not in safe
    ]
    return [safe[at] for at in sorted(safe)], refused


def _simulate_and_check(
    tried: Mapping[int, tuple[Motion, Verdict]],
    approved: ApprovedLimits,
    robots: Mapping[str | None, Robot],
) -> dict[int, SafeMotion]:
    found = {}
    for payload, robot in robots.items():
        own = [at for at, (motion, _) in tried.items() if motion.payload == payload]
        if not own:
            continue
        motions = [tried[at][0] for at in own]
        nominal, worse = (one.responses(motions) for one in (robot.nominal, robot.worse))
        for at, motion, first, second in zip(own, motions, nominal, worse, strict=True):
            verdict = check_simulation(motion, approved, robot.around, first, second)
            kept = (*tried[at][1].kept, *verdict.kept)
            found[at] = SafeMotion(motion, Verdict(kept, verdict.tracking), first)
    return found


def _attempts(design: Design) -> list[tuple[float, int]]:
    seeds = [design.seed]
    if design.kind in _SEVERAL_JOINTS:
        seeds += [design.seed + _SEED_STEP * (1 + at) for at in range(_DRAWN_AGAIN)]
    first = [(scale, seed) for seed in seeds for scale in _FIRST_SCALES]
    return first + [(scale, design.seed) for scale in _LAST_SCALES]
