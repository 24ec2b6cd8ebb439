"""One description for every form of a robot: URDF, MJCF, USD, Pinocchio."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.shapes import Shape

Vector = NDArray[np.float64]


class Dynamics(Protocol):
    """Kinematics and dynamics of a robot; joint values in rad or m, 0 where left out.

    Poses and positions are in the root link. Joints with one degree of freedom alone count.
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
        """(n,) N*m or N that hold the joints against gravity, in the order of ``joints``."""

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
        velocity: limit, rad/s or m/s; effort: limit, N*m or N; None without a limit.
        damping: N*m*s/rad or N*s/m; friction: N*m or N.
        default: position of the loaded model, rad or m.
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
        name: ``MJCF``; engine: what read it.
        links: those with a body of their own.
        joints: those that move.
        independent: degrees of freedom less those that couplings remove.
        actuators: actuator -> (joint, gear, force range in N*m or N or None).
        drives: joint -> feedback of its actuator, in words (gains, bounds).
        mimics: follower -> (leader, multiplier, offset in rad or m).
        constraints: other constraints and tendons, each in words.
        shapes: link -> its collision shapes, sorted by position.
        disabled_pairs: pairs of links whose collision is disabled.
        contact: contact parameters, in words -> count of shapes.
        sensors, transmissions, safety, custom: name -> description.
        stated: row of the matrix -> element -> value, by the table of URDF elements.
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
