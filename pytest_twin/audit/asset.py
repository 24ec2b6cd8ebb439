"""A robot as its file states it, faults included, in one form for every format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pytest_twin.audit.finding import Finding, Place
from pytest_twin.old_names import old_name
from pytest_twin.realization.files.locate import Located
from pytest_twin.realization.mesh import Triangles
from pytest_twin.realization.node import Node

Vector = NDArray[np.float64]
JointKind = Literal["hinge", "slide", "ball", "free", "planar"]


@dataclass(slots=True)
class Body:
    """A link.

    Attributes:
        mass: kg, None where it is not stated.
        com: (3,) centre of mass in the body's frame, m.
        inertia: (3, 3) about the centre of mass, body axes, kg*m^2, None where it is not stated.
        stated: False where a compiler took mass and inertia from the geometry.
        inertial: where mass and inertia stand.
    """

    name: str
    place: Place
    mass: float | None = None
    com: Vector = field(default_factory=lambda: np.zeros(3))
    inertia: Vector | None = None
    stated: bool = True
    inertial: Place | None = None


@dataclass(slots=True)
class Edge:
    """What places a body in its parent.

    Attributes:
        name: of the joint in a URDF, of the child elsewhere.
        position: (3,) of the child in the parent as drawn, m; rotation: (3, 3).
        rpy: (3,) rad as stated, None where the format states no angles.
    """

    name: str
    place: Place
    parent: str
    child: str
    position: Vector
    rotation: Vector
    rpy: Vector | None = None


@dataclass(slots=True)
class Joint:
    """A degree of freedom, or a few, between a body and its parent.

    Attributes:
        body: the one that it moves.
        axis: (3,) unit vector in the body's frame.
        anchor: (3,) in the body's frame, m.
        axis_stated: (3,) as the file states it, None where it does not.
        lower, upper: rad or m, None where not stated.
        is_limited: whether ``lower`` and ``upper`` bind.
        velocity: rad/s or m/s; effort: N*m or N; None where not stated.
        damping: N*m*s/rad or N*s/m; friction: N*m or N; None where not stated.
        reference: position in the pose as drawn, rad or m.
        has_stated_limit: whether there is a ``limit`` element.
        idle_range: (lower, upper) that stand at a continuous joint, where they bind nothing, rad.
        soft: (lower, upper) of a safety controller, rad or m; 0 where it states none.
        has_stated_soft_limit: whether the safety controller states soft limits.
        soft_gain: k_velocity of the safety controller, N*m*s/rad or N*s/m.
    """

    name: str
    place: Place
    kind: JointKind
    body: str
    axis: Vector
    anchor: Vector = field(default_factory=lambda: np.zeros(3))
    axis_stated: Vector | None = None
    lower: float | None = None
    upper: float | None = None
    is_limited: bool = False
    is_continuous: bool = False
    velocity: float | None = None
    effort: float | None = None
    damping: float | None = None
    friction: float | None = None
    reference: float = 0.0
    has_stated_limit: bool = True
    idle_range: tuple[float, float] | None = None
    soft: tuple[float, float] | None = None
    has_stated_soft_limit: bool = False
    soft_gain: float | None = None
    soft_place: Place | None = None

    limited = old_name("limited", "is_limited")
    continuous = old_name("continuous", "is_continuous")
    limit_stated = old_name("limit_stated", "has_stated_limit")
    soft_stated = old_name("soft_stated", "has_stated_soft_limit")

    @property
    def unit(self) -> str:
        """Of its position."""
        return "m" if self.kind == "slide" else "rad"

    @property
    def effort_unit(self) -> str:
        """Of its force or torque."""
        return "N" if self.kind == "slide" else "N*m"

    @property
    def is_scalar(self) -> bool:
        """Whether one number is its position."""
        return self.kind in ("hinge", "slide")

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        return {"hinge": 1, "slide": 1, "ball": 3, "planar": 3, "free": 6}[self.kind]


@dataclass(slots=True)
class Mimic:
    """``follower = multiplier * leader + offset``."""

    place: Place
    follower: str
    leader: str
    multiplier: float
    offset: float
    is_active: bool = True

    active = old_name("active", "is_active")


@dataclass(slots=True)
class Coupling:
    """An equality or tendon beyond one joint that follows another."""

    place: Place
    kind: str
    name: str
    ties: tuple[str, ...]


@dataclass(slots=True)
class Shape:
    """A geometry.

    Attributes:
        size: full sizes, m: box (3,), sphere (radius,), cylinder and capsule (radius, length),
            ellipsoid (3,) half axes.
        file: of a mesh; scale: (3,) as stated.
        triangles: of a mesh, scaled, m; None for primitives and where it could not be read.
    """

    place: Place
    body: str
    role: Literal["visual", "collision"]
    kind: str
    position: Vector
    rotation: Vector
    size: tuple[float, ...] = ()
    file: Path | None = None
    scale: Vector = field(default_factory=lambda: np.ones(3))
    triangles: Triangles | None = None


@dataclass(slots=True)
class Transmission:
    """How a motor drives joints.

    Attributes:
        reductions: of joints and actuators, as stated.
        interfaces: hardware interfaces by joint.
    """

    place: Place
    name: str
    kind: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    reductions: tuple[float, ...] = ()
    interfaces: tuple[str, ...] = ()


@dataclass(slots=True)
class Actuator:
    """What a simulator's model says of a drive.

    Attributes:
        joints: those that it pulls on.
        means: what its command is (``torque``, ``position setpoint``), None where it is not plain.
        lower, upper: of the command, None where unlimited.
        force: largest force or torque at its output, None where unlimited.
        gear: command to generalized force.
    """

    place: Place
    name: str
    joints: tuple[str, ...]
    means: str | None
    lower: float | None = None
    upper: float | None = None
    force: float | None = None
    gear: float = 1.0


@dataclass(slots=True)
class Sensor:
    """A sensor and what bears it."""

    place: Place
    name: str
    kind: str
    bearer: str
    rate: float | None = None


@dataclass(slots=True)
class Controlled:
    """A joint of a ``ros2_control`` element and its interfaces."""

    place: Place
    system: str
    joint: str
    commands: tuple[str, ...]
    states: tuple[str, ...]


@dataclass
class Asset:
    """Everything that was read.

    Attributes:
        kind: ``urdf``, ``mjcf`` or ``usd``.
        named: (kind, name, place) of everything whose names have to differ.
        sites: named frames beside the bodies: name -> (body, position (3,), place).
        poses: name -> joint -> rad or m, as the file declares them (keyframes).
        custom: elements and attributes that no format defines: path -> places.
        faults: what could not be read as it should.
        files: every file that was read; located: where they may lie, None for the default.
        unseen: layers that were not audited, and why.
    """

    kind: Literal["urdf", "mjcf", "usd"]
    path: Path
    name: str
    root: Node | None = None
    bodies: list[Body] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    mimics: list[Mimic] = field(default_factory=list)
    couplings: list[Coupling] = field(default_factory=list)
    shapes: list[Shape] = field(default_factory=list)
    transmissions: list[Transmission] = field(default_factory=list)
    actuators: list[Actuator] = field(default_factory=list)
    sensors: list[Sensor] = field(default_factory=list)
    controlled: list[Controlled] = field(default_factory=list)
    named: list[tuple[str, str, Place]] = field(default_factory=list)
    sites: dict[str, tuple[str, Vector, Place]] = field(default_factory=dict)
    poses: dict[str, dict[str, float]] = field(default_factory=dict)
    custom: dict[str, list[Place]] = field(default_factory=dict)
    faults: list[Finding] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    located: Located | None = None
    unseen: dict[str, str] = field(default_factory=dict)

    @property
    def place(self) -> Place:
        """The root element."""
        return Place(self.path, None if self.root is None else self.root.line)

    @cached_property
    def body(self) -> dict[str, Body]:
        """By name, the first of each."""
        found: dict[str, Body] = {}
        for body in self.bodies:
            found.setdefault(body.name, body)
        return found

    @cached_property
    def joint(self) -> dict[str, Joint]:
        """By name, the first of each."""
        found: dict[str, Joint] = {}
        for joint in self.joints:
            found.setdefault(joint.name, joint)
        return found

    @cached_property
    def joints_of(self) -> dict[str, list[Joint]]:
        """Body -> the joints that move it against its parent."""
        found: dict[str, list[Joint]] = {}
        for joint in self.joints:
            found.setdefault(joint.body, []).append(joint)
        return found

    @cached_property
    def below(self) -> dict[str, list[Edge]]:
        """Body -> edges to its children."""
        found: dict[str, list[Edge]] = {}
        for edge in self.edges:
            found.setdefault(edge.parent, []).append(edge)
        return found

    @cached_property
    def above(self) -> dict[str, Edge]:
        """Body -> the first edge that places it."""
        found: dict[str, Edge] = {}
        for edge in self.edges:
            found.setdefault(edge.child, edge)
        return found

    @cached_property
    def roots(self) -> list[str]:
        """Bodies without a parent."""
        return [name for name in self.body if name not in self.above]

    def in_order(self) -> Iterator[Edge]:
        """Edges from the roots outwards, each body reached once."""
        reached = set(self.roots)
        waiting = list(reversed(self.roots))
        while waiting:
            for edge in self.below.get(waiting.pop(), ()):
                if edge.child not in reached and edge.child in self.body:
                    reached.add(edge.child)
                    waiting.append(edge.child)
                    yield edge

    @cached_property
    def drawn(self) -> dict[str, tuple[Vector, Vector]]:
        """Body -> (3,) position [m] and (3, 3) rotation in its root, as drawn; reached ones."""
        return self.at({})

    def at(self, values: Mapping[str, float]) -> dict[str, tuple[Vector, Vector]]:
        """The same with hinges [rad] and slides [m] at ``values``; the others stand as drawn."""
        found = {name: (np.zeros(3), np.eye(3)) for name in self.roots}
        for edge in self.in_order():
            position, rotation = found[edge.parent]
            position = position + rotation @ edge.position
            rotation = rotation @ edge.rotation
            for joint in self.joints_of.get(edge.child, ()):
                moved = values.get(joint.name, joint.reference) - joint.reference
                if moved and joint.kind == "slide":
                    position = position + rotation @ joint.axis * moved
                elif moved and joint.kind == "hinge":
                    turn = Rotation.from_rotvec(joint.axis * moved).as_matrix()
                    position = position + rotation @ (joint.anchor - turn @ joint.anchor)
                    rotation = rotation @ turn
            found[edge.child] = (position, rotation)
        return found

    @cached_property
    def group(self) -> dict[str, str]:
        """Body -> the topmost body that it does not move against."""
        found = {name: name for name in self.body}
        for edge in self.in_order():
            if not self.joints_of.get(edge.child):
                found[edge.child] = found[edge.parent]
        return found

    @cached_property
    def moving(self) -> set[str]:
        """Topmost bodies of groups that move against what carries them."""
        return {name for name in set(self.group.values()) if self.joints_of.get(name)}

    @cached_property
    def span(self) -> float:
        """Length of the longest way from a root to a body along the tree, m."""
        length = dict.fromkeys(self.roots, 0.0)
        for edge in self.in_order():
            length[edge.child] = length[edge.parent] + float(np.linalg.norm(edge.position))
        return max(length.values(), default=0.0)

    @cached_property
    def beyond(self) -> dict[str, tuple[float, float]]:
        """Body -> mass of it and all that it carries, kg, and its longest way outwards, m."""
        found = {name: (self.body[name].mass or 0.0, 0.0) for name in self.drawn}
        for edge in reversed(list(self.in_order())):
            mass, reach = found[edge.parent]
            carried, further = found[edge.child]
            further += float(np.linalg.norm(edge.position))
            found[edge.parent] = (mass + carried, max(reach, further))
        return found

    def shapes_of(self, body: str) -> list[Shape]:
        """Geometries of a body."""
        return self._shapes_by_body.get(body, [])

    @cached_property
    def _shapes_by_body(self) -> dict[str, list[Shape]]:
        found: dict[str, list[Shape]] = {}
        for shape in self.shapes:
            found.setdefault(shape.body, []).append(shape)
        return found
