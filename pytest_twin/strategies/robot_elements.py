"""Links and joints of a random robot, from which its URDF and MJCF are written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Triple = tuple[float, float, float]
JointKind = Literal["revolute", "continuous", "prismatic", "fixed"]
MOVING: tuple[JointKind, ...] = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, slots=True)
class DrawnShape:
    """A collision shape.

    Attributes:
        kind: ``box``, ``sphere``, ``cylinder``, or ``mesh`` (a wedge).
        size: full lengths of a box or wedge; radius; radius and length, m.
        position, rpy: pose in the link, m, and rad about fixed axes.
        file: name of the mesh file.
    """

    kind: Literal["box", "sphere", "cylinder", "mesh"]
    size: tuple[float, ...]
    position: Triple
    rpy: Triple
    file: str


@dataclass(frozen=True, slots=True)
class DrawnLink:
    """A rigid body.

    Attributes:
        mass: kg, 0 for a frame without mass.
        com: (3,) centre of mass in the link, m.
        rpy: (3,) orientation of the principal axes in the link, rad.
        moments: (3,) principal moments about the centre of mass, kg*m^2.
    """

    name: str
    mass: float
    com: Triple
    rpy: Triple
    moments: Triple
    shapes: tuple[DrawnShape, ...] = ()


@dataclass(frozen=True, slots=True)
class DrawnJoint:
    """Joint between a parent and a child link, as in URDF.

    Attributes:
        kind: type of joint in URDF.
        position, rpy: pose of the child in the parent, m, and rad about fixed axes.
        axis: (3,) unit vector in the child.
        limits: (lower, upper), rad or m, or None.
        effort, velocity: limits, N*m or N, rad/s or m/s, or None.
        damping: N*m*s/rad or N*s/m.
        friction: N*m or N.
        mimic: (leader, multiplier, offset in rad or m), or None.
    """

    name: str
    kind: JointKind
    parent: str
    child: str
    position: Triple
    rpy: Triple
    axis: Triple
    limits: tuple[float, float] | None = None
    effort: float | None = None
    velocity: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    mimic: tuple[str, float, float] | None = None

    def following(
        self, leader: str, multiplier: float, offset: float, limits: tuple[float, float]
    ) -> DrawnJoint:
        """The same joint as a mimic of ``leader``: ``multiplier * leader + offset``, rad or m."""
        return replace(self, mimic=(leader, multiplier, offset), limits=limits)
