"""Data classes of the approved limits for excitation, ``excitation:`` of ``twin.yaml``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray

DEFAULT_MARGIN = 0.05
"""Default share of each approved limit that motions do not use."""
MECHANISMS = ("delay", "closed_loop", "friction", "backlash", "gravity", "payload", "inertia")
"""Mechanisms that can be identified, in the order of identification."""


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Approved limits of one joint, in the model's sign and zero.

    Attributes:
        lower, upper: position limits, rad or m.
        velocity, acceleration: largest values, rad/s and rad/s^2, or m/s and m/s^2.
        effort: largest effort, N*m or N.
        start: position at the begin and end of every trajectory, rad or m.
        is_slide: whether it is a slide and not a hinge.
        effort_noise, position_noise: standard deviation of one sample, N*m or N and rad or m;
            None if not declared.
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
        """Return the unit of positions."""
        return "m" if self.is_slide else "rad"

    @property
    def effort_unit(self) -> str:
        """Return the unit of efforts."""
        return "N" if self.is_slide else "N*m"


@dataclass(frozen=True, slots=True)
class Box:
    """A box in the world frame, m, that the origin of a frame must not leave."""

    frame: str
    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True, slots=True)
class Clearance:
    """Smallest permitted distances, m.

    Attributes:
        between_links: for two moving bodies that can collide.
        to_environment: for a moving and a fixed body.
        pairs: two bodies or geoms -> distance for this pair.
        ignored: pairs of bodies that may touch.
    """

    between_links: float
    to_environment: float
    pairs: Mapping[tuple[str, str], float]
    ignored: frozenset[frozenset[str]]


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop of the robot after an abort.

    Attributes:
        category: 0, 1 or 2 of IEC 60204-1.
        reaction: time from the abort to the start of braking, s.
        plan: description of who stops the robot, and how.
    """

    category: int
    reaction: float
    plan: str


@dataclass(frozen=True, slots=True)
class ApprovedLimits:
    """All limits that a trajectory must satisfy.

    Attributes:
        approved_by: person who approved the limits.
        duration: longest time of one trajectory, s.
        rate: rate of commands, Hz.
        band: lowest and highest frequency of the task's motion, Hz.
        margin: share of each limit that motions do not use.
        workspace: boxes for frames.
        clearance: smallest distances; None if a person approved motion without this check.
        power: continuous power of the supply, W.
        stop: stop after an abort.
        source: the section as written.
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
        """Return the names of the moving joints."""
        return tuple(joint.name for joint in self.joints)

    def array(self, attribute: str) -> FloatArray:
        """Return one attribute of all joints, (j,)."""
        return np.array([getattr(joint, attribute) for joint in self.joints], dtype=np.float64)

    @property
    def start(self) -> FloatArray:
        """Return the (j,) start positions, rad or m."""
        return self.array("start")

    @property
    def room(self) -> tuple[FloatArray, FloatArray]:
        """Return (j,) lowest and highest position within the margin, relative to the start."""
        lower, upper, start = self.array("lower"), self.array("upper"), self.start
        free = self.margin * (upper - lower) / 2.0
        return np.minimum(lower + free, start), np.maximum(upper - free, start)

    @property
    def speed(self) -> FloatArray:
        """Return the (j,) largest speeds within the margin."""
        return self.array("velocity") * (1.0 - self.margin)

    @property
    def acceleration(self) -> FloatArray:
        """Return the (j,) largest accelerations within the margin."""
        return self.array("acceleration") * (1.0 - self.margin)

    @property
    def effort(self) -> FloatArray:
        """Return the (j,) largest efforts within the margin."""
        return self.array("effort") * (1.0 - self.margin)


def missing_lines(section: Mapping[str, Any], joints: Sequence[str]) -> list[str]:
    """Return the dotted fields of ``excitation:`` that are missing.

    Args:
        section: the section as written.
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
"""Value of ``clearance:`` with which a person approves motion without a check of distances."""
_SCALARS = ("approved_by", "mechanisms", "duration", "rate", "task_band", "workspace")
_OF_A_JOINT = ("position", "velocity", "acceleration", "effort", "start")


def _missing_of(section: Mapping[str, Any], table: str, names: Sequence[str]) -> list[str]:
    own = section.get(table) or {}
    return [f"{table}.{name}" for name in names if own.get(name) is None]
