"""Check a motion against all approved limits, and compute the margins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.clearance import ClearanceChecker
from pytest_twin.excitation.closed_loop import Response
from pytest_twin.excitation.motion import Motion

_ROUNDING = 1e-9
"""Relative rounding error that is tolerated at a limit."""


@dataclass(frozen=True, slots=True)
class LimitCheck:
    """One limit and the worst value of a motion.

    Attributes:
        what: description of the limit, ``velocity of elbow, commanded``.
        value: the worst value along the motion.
        unit: unit of both.
        share: used share of the limit; above 1 the limit is exceeded.
    """

    what: str
    value: float
    limit: float
    unit: str
    share: float

    @property
    def holds(self) -> bool:
        """Whether the limit is kept."""
        return self.share <= 1.0 + _ROUNDING

    @property
    def words(self) -> str:
        """Return limit, value and unit as a line of text."""
        return f"{self.what}: {self.value:.4g} {self.unit}, limit {self.limit:.4g} {self.unit}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """All limits of a motion.

    Attributes:
        kept: limits with their worst values.
        tracking: (j,) largest distance of a simulated position from its command, rad or m.
        notes: limits that were not checked.
    """

    kept: tuple[LimitCheck, ...]
    tracking: FloatArray = field(default_factory=lambda: np.zeros(0))
    notes: tuple[str, ...] = ()

    @property
    def is_safe(self) -> bool:
        """Whether every limit is kept."""
        return all(one.holds for one in self.kept)

    @property
    def worst(self) -> LimitCheck:
        """Return the limit with the largest used share."""
        return max(self.kept, key=lambda one: one.share)

    def of_kind(self, kind: str) -> LimitCheck | None:
        """Return the limit of one kind (first word of ``what``) with the largest used share."""
        own = [one for one in self.kept if one.what.split(" ")[0] == kind]
        return max(own, key=lambda one: one.share) if own else None


def check_commands(motion: Motion, approved: ApprovedLimits, around: ClearanceChecker) -> Verdict:
    """Check the commands, with derivatives by differences of the sent values."""
    lower, upper = approved.room
    rate = approved.rate
    velocity = np.diff(motion.position, axis=0) * rate
    acceleration = np.diff(motion.position, 2, axis=0) * rate**2
    seconds = float(motion.time[-1])
    kept = [LimitCheck("duration", seconds, approved.duration, "s", seconds / approved.duration)]
    kept += _positions(motion.position, lower, upper, approved, "commanded")
    kept += _sizes("velocity", velocity, approved.speed, approved, "commanded", "/s")
    kept += _sizes(
        "acceleration", acceleration, approved.acceleration, approved, "commanded", "/s^2"
    )
    kept += _stops(motion, approved)
    if all(one.holds for one in kept):
        kept += _clearance_checks(motion.position, around)
    return Verdict(tuple(kept))


def check_simulation(
    motion: Motion,
    approved: ApprovedLimits,
    around: ClearanceChecker,
    nominal: Response,
    worse: Response,
) -> Verdict:
    """Check simulated motion and efforts of the nominal and of the worse model."""
    kept: list[LimitCheck] = []
    tracking = np.zeros(len(approved.joints))
    for name, response in (("nominal model", nominal), ("20 % worse model", worse)):
        if response.error is not None:
            kept.append(
                LimitCheck(f"simulation of the {name}: {response.error}", 1.0, 0.0, "", np.inf)
            )
            return Verdict(tuple(kept), tracking)
        is_nominal = response is nominal
        share = 1.0 - approved.margin if is_nominal else 1.0
        kept += _positions(
            response.position, approved.array("lower"), approved.array("upper"), approved, name
        )
        kept += _sizes(
            "velocity", response.velocity, approved.array("velocity"), approved, name, "/s"
        )
        kept += _sizes("effort", response.effort, share * approved.array("effort"), approved, name)
        power = np.maximum(response.effort * response.velocity, 0.0).sum(axis=1)
        most = float(power.max())
        limit = share * approved.power
        kept.append(LimitCheck(f"power of all drives, {name}", most, limit, "W", most / limit))
        tracking = np.maximum(tracking, np.abs(response.position - motion.position).max(axis=0))
    # If joints follow exactly, the checks of the commands suffice.
    if nominal.position is not motion.position and all(one.holds for one in kept):
        kept += _clearance_checks(nominal.position, around, ", nominal model")
    return Verdict(tuple(kept), tracking)


def _positions(
    position: FloatArray, lower: FloatArray, upper: FloatArray, approved: ApprovedLimits, whose: str
) -> list[LimitCheck]:
    found = []
    for at, joint in enumerate(approved.joints):
        # As shares of the distance from the start to the limit.
        up = (position[:, at].max() - joint.start) / max(upper[at] - joint.start, 1e-12)
        down = (joint.start - position[:, at].min()) / max(joint.start - lower[at], 1e-12)
        value, limit, share = (
            (position[:, at].max(), upper[at], up)
            if up >= down
            else (position[:, at].min(), lower[at], down)
        )
        found.append(
            LimitCheck(
                f"position of {joint.name}, {whose}",
                float(value),
                float(limit),
                joint.unit,
                float(share),
            )
        )
    return found


def _sizes(
    what: str,
    values: FloatArray,
    limits: FloatArray,
    approved: ApprovedLimits,
    whose: str,
    per: str | None = None,
) -> list[LimitCheck]:
    most = np.abs(values).max(axis=0) if len(values) else np.zeros(len(limits))
    return [
        LimitCheck(
            f"{what} of {joint.name}, {whose}",
            float(most[at]),
            float(limits[at]),
            joint.effort_unit if per is None else f"{joint.unit}{per}",
            float(most[at] / limits[at]),
        )
        for at, joint in enumerate(approved.joints)
    ]


def _stops(motion: Motion, approved: ApprovedLimits) -> list[LimitCheck]:
    """Check the rest positions of each joint after an abort at any time."""
    found = []
    reaction = approved.stop.reaction
    for at, joint in enumerate(approved.joints):
        speed = motion.velocity[:, at]
        way = speed * reaction + np.sign(speed) * speed**2 / (2.0 * joint.acceleration)
        end = motion.position[:, at] + way
        for value, limit, sign in (
            (float(end.max()), joint.stop_upper, 1.0),
            (float(end.min()), joint.stop_lower, -1.0),
        ):
            if not np.isfinite(limit):
                continue
            room = sign * (limit - joint.start)
            share = sign * (value - joint.start) / max(room, 1e-12)
            found.append(
                LimitCheck(f"stop of {joint.name}, aborted", value, limit, joint.unit, share)
            )
    return found


def _clearance_checks(
    position: FloatArray, around: ClearanceChecker, whose: str = ""
) -> list[LimitCheck]:
    found = []
    box = around.least_box_spare(position)
    if box is not None:
        spare, frame, _ = box
        found.append(
            LimitCheck(
                f"workspace: room of {frame} in its box{whose}", spare, 0.0, "m", _share(spare)
            )
        )
    nearest = around.nearest(position)
    if nearest is not None:
        first, second = nearest.pair
        found.append(
            LimitCheck(
                f"clearance of {first} and {second}{whose}",
                nearest.distance,
                nearest.required,
                "m",
                _share(nearest.spare, nearest.required),
            )
        )
    return found


def _share(spare: float, required: float = 0.0) -> float:
    """Return the used share of a distance: 1 if none is spare, above 1 if it is too small."""
    scale = max(required, 0.01)
    return scale / (scale + spare) if spare >= 0.0 else 1.0 - spare / scale


def reasons(verdicts: Sequence[Verdict]) -> list[str]:
    """Return descriptions of all exceeded limits, each once, the worst first."""
    broken = [one for verdict in verdicts for one in verdict.kept if not one.holds]
    broken.sort(key=lambda one: -one.share)
    return list(dict.fromkeys(one.words for one in broken))
