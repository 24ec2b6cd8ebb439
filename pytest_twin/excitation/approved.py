"""What a qualified person approved for excitation, read from ``excitation:`` of ``twin.yaml``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray

DEFAULT_MARGIN = 0.05
"""Share of each approved limit that the motion leaves free."""
MECHANISMS = ("delay", "closed_loop", "friction", "backlash", "gravity", "payload", "inertia")
"""What can be asked for, in the order in which it is identified."""


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Approved limits of one joint, in the model's sign and zero.

    Attributes:
        lower, upper: position, rad or m.
        velocity, acceleration: rad/s, rad/s^2, or m/s, m/s^2.
        effort: N*m or N.
        start: where every trajectory begins and ends, rad or m.
        is_slide: whether it is a slide and not a hinge.
        effort_noise, position_noise: standard deviation of one sample, where it is declared.
        stop_lower, stop_upper: the joint's own range in the model, rad or m; infinite without one.
    """

    name: str
    lower: float
    upper: float
    velocity: float
    acceleration: float
    effort: float
    start: float
    is_slide: bool
    effort_noise: float | None = None
    position_noise: float | None = None
    stop_lower: float = -math.inf
    stop_upper: float = math.inf

    @property
    def unit(self) -> str:
        """Of positions."""
        return "m" if self.is_slide else "rad"

    @property
    def effort_unit(self) -> str:
        """Of efforts."""
        return "N" if self.is_slide else "N*m"


@dataclass(frozen=True, slots=True)
class Box:
    """A box in the world, m, that the origin of a frame stays in."""

    frame: str
    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True, slots=True)
class Clearance:
    """Least distances in m.

    Attributes:
        between_links: of any two moving bodies that can collide.
        to_environment: of a moving body and one that stands still.
        pairs: two bodies or geoms -> a distance of their own.
        ignored: pairs of bodies that may touch.
    """

    between_links: float
    to_environment: float
    pairs: Mapping[tuple[str, str], float]
    ignored: frozenset[frozenset[str]]


@dataclass(frozen=True, slots=True)
class Stop:
    """How the motion is stopped.

    Attributes:
        category: 0, 1 or 2 of IEC 60204-1.
        reaction: s from the abort to the first braking.
        plan: who stops the robot, and how.
    """

    category: int
    reaction: float
    plan: str


@dataclass(frozen=True, slots=True)
class Approved:
    """Everything that a trajectory must keep to.

    Attributes:
        approved_by: who approved it.
        mechanisms: what is asked for.
        duration: longest time of one trajectory, s.
        rate: commands per second, Hz.
        band: lowest and highest frequency of the task's motion, Hz.
        margin: share of each limit that is left free.
        joints: those that move.
        workspace: boxes.
        clearance: least distances; None where a person approved to go without.
        power: W that the supply gives without end.
        stop: how the motion is stopped.
        source: the section as it is written.
    """

    approved_by: str
    mechanisms: tuple[str, ...]
    duration: float
    rate: float
    band: tuple[float, float]
    margin: float
    joints: tuple[JointLimits, ...]
    workspace: tuple[Box, ...]
    clearance: Clearance | None
    power: float
    stop: Stop
    source: Mapping[str, Any]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints that move."""
        return tuple(joint.name for joint in self.joints)

    def array(self, attribute: str) -> FloatArray:
        """(j,) one attribute of every joint."""
        return np.array([getattr(joint, attribute) for joint in self.joints], dtype=np.float64)

    @property
    def start(self) -> FloatArray:
        """(j,) where every trajectory begins and ends."""
        return self.array("start")

    @property
    def room(self) -> tuple[FloatArray, FloatArray]:
        """(j,) lowest and highest position with the margin left free, about the start."""
        lower, upper, start = self.array("lower"), self.array("upper"), self.start
        free = self.margin * (upper - lower) / 2.0
        return np.minimum(lower + free, start), np.maximum(upper - free, start)

    @property
    def speed(self) -> FloatArray:
        """(j,) greatest speed with the margin left free."""
        return self.array("velocity") * (1.0 - self.margin)

    @property
    def acceleration(self) -> FloatArray:
        """(j,) greatest acceleration with the margin left free."""
        return self.array("acceleration") * (1.0 - self.margin)

    @property
    def effort(self) -> FloatArray:
        """(j,) greatest effort with the margin left free."""
        return self.array("effort") * (1.0 - self.margin)


def missing_lines(section: Mapping[str, Any], joints: Sequence[str]) -> list[str]:
    """Dotted fields of ``excitation:`` that are not filled in.

    Args:
        section: as written.
        joints: all joints of the model that can be moved.
    """
    missing = [name for name in _SCALARS if section.get(name) is None]
    approved, held = section.get("joints") or {}, section.get("hold") or ()
    for joint in joints:
        if joint in held:
            continue
        own = approved.get(joint) or {}
        for name in _OF_A_JOINT:
            value = own.get(name)
            if value is None or (isinstance(value, list) and None in value):
                missing.append(f"joints.{joint}.{name}")
    missing += [
        f"workspace.{at}.{name}"
        for at, box in enumerate(section.get("workspace") or ())
        for name in ("min", "max")
        if box.get(name) is None
    ]
    if section.get("clearance") != NO_CLEARANCE:
        missing += _missing_of(section, "clearance", ("self", "environment"))
    missing += _missing_of(section, "supply", ("voltage", "current"))
    missing += _missing_of(section, "stop", ("category", "reaction", "plan"))
    return missing


NO_CLEARANCE = "none"
"""Written for ``clearance:`` where a person approves motion without a check of distances."""
_SCALARS = ("approved_by", "mechanisms", "duration", "rate", "task_band", "workspace")
_OF_A_JOINT = ("position", "velocity", "acceleration", "effort", "start")


def _missing_of(section: Mapping[str, Any], table: str, names: Sequence[str]) -> list[str]:
    own = section.get(table) or {}
    return [f"{table}.{name}" for name in names if own.get(name) is None]
