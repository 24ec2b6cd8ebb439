"""A common description of a robot for all forms: URDF, MJCF, USD, Pinocchio."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.shapes import Shape

Vector = NDArray[np.float64]


class Dynamics(Protocol):
    """Kinematics and dynamics of a robot; joint values in rad or m, 0 if omitted.

    Poses and positions are in the root link's frame. Only joints with one degree of freedom are
    included.
    """

    @property
    def joints(self) -> tuple[str, ...]:
        """Return the joints with one degree of freedom."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the links and frames that have a pose."""

    def poses(self, q: Mapping[str, float]) -> Mapping[str, Vector]:
        """Return ``transform_root_to_frame`` (4, 4) of every frame."""

    def mass(self) -> float:
        """Return the total mass, kg."""

    def center_of_mass(self, q: Mapping[str, float]) -> Vector:
        """Return the (3,) centre of mass in the root frame, m."""

    def gravity_torque(self, q: Mapping[str, float]) -> Vector:
        """Return (n,) efforts that hold the joints against gravity, N*m or N, as ``joints``."""

    def mass_matrix(self, q: Mapping[str, float]) -> Vector:
        """Return the (n, n) joint-space mass matrix in the order of ``joints``, SI units."""


@dataclass(frozen=True, slots=True)
class LinkFacts:
    """Inertial properties of a body.

    Attributes:
        mass: mass, kg.
        com: (3,) centre of mass in the link's frame, m.
        inertia: (3, 3) about the centre of mass, link axes, kg*m^2.
    """

    mass: float
    com: Vector
    inertia: Vector


@dataclass(frozen=True, slots=True)
class JointFacts:
    """Properties of a moving joint.

    Attributes:
        kind: ``hinge``, ``slide``, ``free``, ``planar``.
        range: (lower, upper), rad or m; None if unlimited.
        velocity: velocity limit, rad/s or m/s; None if unlimited.
        effort: effort limit, N*m or N; None if unlimited.
        damping: viscous friction, N*m*s/rad or N*s/m.
        friction: Coulomb friction, N*m or N.
        default: position in the model's default state, rad or m.
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
    """Description of one form of a robot.

    Attributes:
        name: name of the form, such as ``MJCF``.
        engine: parser or simulator that read it.
        links: links that have their own body.
        independent: degrees of freedom less those that couplings remove.
        actuators: actuator -> (joint, gear, force range in N*m or N or None).
        drives: joint -> description of its actuator's feedback (gains, limits).
        mimics: follower -> (leader, multiplier, offset in rad or m).
        constraints: descriptions of other constraints and tendons.
        shapes: link -> its collision shapes, sorted by position.
        disabled_pairs: pairs of links whose collision is disabled.
        contact: description of contact parameters -> number of shapes.
        sensors, transmissions, safety, custom: name -> description.
        stated: row of the loss matrix -> element -> value, from the table of URDF elements.
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
        """Return the joints with an actuator."""
        return frozenset(joint for joint, _, _ in self.actuators.values())

    @property
    def passive(self) -> frozenset[str]:
        """Return the joints without actuator and mimic."""
        return frozenset(self.joints) - self.driven - frozenset(self.mimics)
