"""What one form of a robot says and does, told alike for every form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.shapes import Shape

Vector = NDArray[np.float64]


class Dynamics(Protocol):
    """A robot that can be asked; joint values in rad or m, those left out at zero.

    Poses and positions are told from the root link. Only joints of one degree of freedom count.
    """

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints of one degree of freedom."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Links and frames that have a pose."""

    def poses(self, q: Mapping[str, float]) -> Mapping[str, Vector]:
        """``transform_root_to_frame`` (4, 4) of every frame."""

    def mass(self) -> float:
        """kg."""

    def center_of_mass(self, q: Mapping[str, float]) -> Vector:
        """(3,) m."""

    def gravity_torque(self, q: Mapping[str, float]) -> Vector:
        """(n,) N*m or N that holds each joint still, in the order of ``joints``."""

    def mass_matrix(self, q: Mapping[str, float]) -> Vector:
        """(n, n) in the order of ``joints``."""


@dataclass(frozen=True, slots=True)
class LinkFacts:
    """A body of its own.

    Attributes:
        mass: kg.
        com: (3,) in the link, m.
        inertia: (3, 3) about that centre, link axes, kg*m^2.
    """

    mass: float
    com: Vector
    inertia: Vector


@dataclass(frozen=True, slots=True)
class JointFacts:
    """A joint that moves.

    Attributes:
        kind: ``hinge``, ``slide``, ``free``, ``planar``.
        range: (lower, upper) rad or m, None where it is unlimited.
        velocity: rad/s or m/s; effort: N*m or N: the greatest, None where there is no bound.
        damping: N*m*s/rad or N*s/m; friction: N*m or N.
        default: rad or m, where it stands when the model is loaded.
    """

    kind: str
    range: tuple[float, float] | None = None
    velocity: float | None = None
    effort: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    default: float = 0.0


@dataclass(frozen=True, slots=True)
class Description:
    """One form of a robot.

    Attributes:
        name: what it is called, ``MJCF``; engine: what read it.
        links: those with a body of their own.
        joints: those that move.
        independent: degrees of freedom that are left when every coupling holds.
        actuators: actuator -> (joint, gear, force range in N*m or N or None).
        drives: joint -> what closes a loop around it, in words (gains, bounds).
        mimics: follower -> (leader, multiplier, offset in rad or m).
        constraints: other constraints and tendons, each in words.
        shapes: link -> its collision shapes, in the order of where they lie.
        disabled_pairs: pairs of links that are kept from colliding.
        contact: contact parameters that shapes have, in words -> how many have them.
        sensors, transmissions, safety, custom: name -> what there is of it, in words.
        stated: row of the matrix -> element -> its value, of what has a row for no other reason.
    """

    name: str
    engine: str
    dynamics: Dynamics
    links: Mapping[str, LinkFacts]
    joints: Mapping[str, JointFacts]
    independent: int
    actuators: Mapping[str, tuple[str, float, tuple[float, float] | None]]
    drives: Mapping[str, str] = field(default_factory=dict)
    mimics: Mapping[str, tuple[str, float, float]] = field(default_factory=dict)
    constraints: tuple[str, ...] = ()
    shapes: Mapping[str, tuple[Shape, ...]] = field(default_factory=dict)
    disabled_pairs: frozenset[frozenset[str]] = frozenset()
    contact: Mapping[str, int] = field(default_factory=dict)
    sensors: Mapping[str, str] = field(default_factory=dict)
    transmissions: Mapping[str, str] = field(default_factory=dict)
    safety: Mapping[str, str] = field(default_factory=dict)
    custom: Mapping[str, int] = field(default_factory=dict)
    stated: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def driven(self) -> frozenset[str]:
        """Joints that an actuator acts on."""
        return frozenset(joint for joint, _, _ in self.actuators.values())

    @property
    def passive(self) -> frozenset[str]:
        """Joints that neither an actuator nor a mimic moves."""
        return frozenset(self.joints) - self.driven - frozenset(self.mimics)
