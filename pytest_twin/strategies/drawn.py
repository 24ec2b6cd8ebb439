"""Links and joints of a drawn robot: what its URDF and its MJCF both say."""

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
        kind: ``box``, ``sphere``, ``cylinder``, or ``mesh``: a wedge.
        size: full lengths of a box or wedge; radius; radius and length, m.
        position, rpy: of the shape in the link, m and rad about fixed axes.
        file: name of the mesh's file.
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
        mass: kg, 0 for a frame without a body.
        com: centre of mass in the link, m; rpy: of the principal axes in it, rad.
        moments: principal moments about the centre of mass, kg*m^2.
    """

    name: str
    mass: float
    com: Triple
    rpy: Triple
    moments: Triple
    shapes: tuple[DrawnShape, ...] = ()


@dataclass(frozen=True, slots=True)
class DrawnJoint:
    """What ties a child link to its parent, as URDF has it.

    Attributes:
        position, rpy: of the child in the parent, m and rad about fixed axes.
        axis: unit vector in the child.
        limits: rad or m; effort: N*m or N; velocity: rad/s or m/s; None where there is none.
        damping: N*m*s/rad or N*s/m; friction: N*m or N.
        mimic: (leader, multiplier, offset in rad or m).
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
        """The same joint, tied to another."""
        return replace(self, mimic=(leader, multiplier, offset), limits=limits)
