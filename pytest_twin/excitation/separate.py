"""Choose the bounded motion that tells two hypotheses apart best."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.approved_robot import ApprovedRobot
from pytest_twin.excitation.candidates import candidates
from pytest_twin.excitation.closed_loop import servo_modes
from pytest_twin.excitation.discrimination import Separation
from pytest_twin.excitation.excite import Excitation, state_limit, write_motions
from pytest_twin.excitation.find_safe import RejectedDesign, SafeMotion
from pytest_twin.excitation.hypotheses import (
    Rival,
    read_diagnosed,
    read_rivals,
)
from pytest_twin.excitation.motion import Role
from pytest_twin.excitation.motion_search import Judged, chosen_within_limit, safe_motions, search
from pytest_twin.excitation.responses import Noise
from pytest_twin.excitation.separators import Separator, separator_of
from pytest_twin.time_limit import limited

DECIDED = 0.9
"""Expected probability from which a motion tells two hypotheses apart."""
_FINALISTS = 4
"""Number of motions whose safety is checked by simulation, the best first."""
_USUAL = ("steps", "chirp", "reversals", "fourier")
"""Kinds of the motions that ``excite`` designs without hypotheses."""


@dataclass(frozen=True)
class ChosenMotions:
    """The motions that were chosen.

    Attributes:
        truths: parameters of both hypotheses that are taken for true.
        motions: safe motions with their separation, the best first.
        refused: designs without a safe motion.
        usual: the best of the motions that ``excite`` designs without hypotheses; None if there is
            none within the limits.
        tried: number of motions that were simulated.
    """

    truths: tuple[Mapping[str, Any], Mapping[str, Any]] = ({}, {})
    motions: tuple[tuple[SafeMotion, Separation], ...] = ()
    refused: tuple[RejectedDesign, ...] = ()
    usual: Judged[Separation] | None = None
    tried: int = 0


def separate_file(
    model: str,
    out: str,
    words: str,
    diagnosis: str | None,
    seed: int,
    progress: Callable[[float], None] = lambda fraction: None,
    seconds: float = 0.0,
) -> dict[str, Any]:
    """Choose the motion, check and write it; runs in the child process.

    Args:
        model: ``twin.yaml``.
        out: folder for the motions.
        words: ``EFFECT[@JOINT],EFFECT[@JOINT]``.
        diagnosis: folder of a diagnosis with parameters and noise; None without one.
        seed, progress, seconds: as for :func:`~pytest_twin.excitation.excite.excite_file`.

    Returns:
        ``document``, ``abort`` and ``drawn`` as of ``excite_file``.
    """
    with limited(seconds) as limit:
        robot = ApprovedRobot.load(Path(model), seed)
        diagnosed = None if diagnosis is None else read_diagnosed(Path(diagnosis))
        names = robot.approved.names
        rivals = read_rivals(words, names, servo_modes(robot.realization, names), diagnosed)
        separator = separator_of(robot, rivals, diagnosed)
        moved = sorted({j for rival in rivals for j in _joints_of(rival, len(names))})
        chosen = chosen_within_limit(
            lambda: separate(robot, separator, moved, progress), ChosenMotions()
        )
    written = _written(robot, chosen, Path(model), Path(out))
    written["document"]["separation"] = _document(robot, rivals, separator.noise, chosen)
    state_limit(written["document"], limit)
    return written


def separate(
    robot: ApprovedRobot,
    separator: Separator,
    moved: Sequence[int],
    progress: Callable[[float], None] = lambda fraction: None,
) -> ChosenMotions:
    """Choose the safe motion with the largest expected odds.

    Motions of single joints, random Fourier series and random moves are simulated under both
    hypotheses; then the best moves are varied, as in an evolution strategy.

    Args:
        moved: columns of the joints that the hypotheses are about.

    Raises:
        OutOfTime: the time limit is over before the first motions are compared.
    """
    first = candidates(robot.approved, robot.loads, robot.optimal, moved, robot.seed)
    judged = search(robot, first, moved, separator.separations, lambda done: progress(0.9 * done))
    usual = next((one for one in judged if one.motion.kind in _USUAL), None)
    safe, refused = safe_motions(robot, judged[:_FINALISTS])
    final = _of_safe(safe, judged, separator)
    return ChosenMotions(separator.truths(), final, tuple(refused), usual, len(judged))


def _joints_of(rival: Rival, count: int) -> Sequence[int]:
    return range(count) if rival.term.joint < 0 else (rival.term.joint,)


def _of_safe(
    safe: Sequence[SafeMotion], judged: Sequence[Judged[Separation]], separator: Separator
) -> tuple[tuple[SafeMotion, Separation], ...]:
    """Safe motions with their separation, the best first; scaled ones are simulated again."""
    known = {one.motion.name: one for one in judged}
    by_name = {one.motion.name: known[one.motion.name].score for one in safe}
    again = [
        one.motion for one in safe
        if not np.array_equal(known[one.motion.name].motion.position, one.motion.position)
    ]  # fmt: skip
    if again:
        for motion, found in zip(again, separator.separations(again), strict=True):
            by_name[motion.name] = found
    both = [(one, by_name[one.motion.name]) for one in safe]
    both.sort(key=lambda one: one[1].rank, reverse=True)
    return tuple(both[:2])


def _written(robot: ApprovedRobot, chosen: ChosenMotions, twin: Path, out: Path) -> dict[str, Any]:
    """Write the chosen motions: the best to fit, the second to hold out."""
    roles: tuple[Role, ...] = ("fit", "held_out")
    safe = tuple(
        replace(one, motion=replace(one.motion, role=role))
        for role, (one, _) in zip(roles, chosen.motions, strict=False)
    )
    excitation = Excitation(
        robot.realization, replace(robot.approved, mechanisms=()), robot.noise, robot.regressor,
        robot.base, safe, () if safe else chosen.refused, (), robot.seed,
    )  # fmt: skip
    written = write_motions(excitation, twin, out)
    is_separated = bool(chosen.motions) and chosen.motions[0][1].probability >= DECIDED
    written["document"]["verdict"] = "separable" if is_separated else "not_separable"
    return written


def _document(
    robot: ApprovedRobot, rivals: tuple[Rival, Rival], noise: Noise, chosen: ChosenMotions
) -> dict[str, Any]:
    """Section ``separation`` of ``excitation.json``."""
    return {
        "hypotheses": [
            {
                "name": rival.name,
                "effect": rival.term.effect,
                "joint": None if rival.term.joint < 0 else robot.approved.names[rival.term.joint],
                "parameters": dict(truth),
                "source": "diagnosis" if rival.diagnosed else "typical size",
            }
            for rival, truth in zip(rivals, chosen.truths, strict=True)
        ],
        "expected": [
            _expected(rivals, one.motion.name, separation) for one, separation in chosen.motions
        ],
        "usual_motion": None
        if chosen.usual is None
        else _expected(rivals, chosen.usual.motion.name, chosen.usual.score),
        "needed": DECIDED,
        **noise_section(robot, noise),
        "tried": chosen.tried,
    }


def noise_section(robot: ApprovedRobot, noise: Noise) -> dict[str, Any]:
    """Return the signals that count, and their noise, as ``excitation.json`` writes them."""
    return {
        "signals": " and ".join(
            name
            for name, own in (("positions", noise.position), ("efforts", noise.effort))
            if own is not None
        ),
        "noise": {
            joint.name: {
                "position": _size(noise.position, at, joint.unit),
                "effort": _size(noise.effort, at, joint.effort_unit),
            }
            for at, joint in enumerate(robot.approved.joints)
        },
    }


def _expected(rivals: tuple[Rival, Rival], name: str, separation: Separation) -> Mapping[str, Any]:
    """Expected odds of one motion, and how far the hypotheses differ if each is true."""
    return {
        "trajectory": name,
        "probability": round(separation.probability, 4),
        "log_odds": round(separation.log_odds, 2),
        "if_true": {
            rival.name: {
                "log_odds": round(one.log_odds, 2),
                "difference_in_noise": _rms(one.difference),
            }
            for rival, one in zip(rivals, separation.imitations, strict=True)
        },
    }


def _rms(difference: FloatArray) -> float | None:
    """RMS difference of the signal that differs most, in standard deviations of its noise."""
    value = float(np.sqrt((difference**2).mean(axis=0)).max())
    return round(value, 3) if np.isfinite(value) else None


def _size(values: FloatArray | None, at: int, unit: str) -> dict[str, Any] | None:
    return None if values is None else {"value": float(values[at]), "unit": unit}
