"""Data classes for a robot as stated in its file, faults included, independent of the format."""

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
from pytest_twin.realization.files.locate import ModelFolders
from pytest_twin.realization.mesh import Triangles
from pytest_twin.realization.node import Node

Vector = NDArray[np.float64]
JointKind = Literal["hinge", "slide", "ball", "free", "planar"]


@dataclass(slots=True)
class Body:
    """A link of the robot.

    Attributes:
        mass: kg, None if it is not stated.
        com: (3,) centre of mass in the body's frame, m.
        inertia: (3, 3) about the centre of mass, body axes, kg*m^2, None if it is not stated.
        stated: False if a compiler computed mass and inertia from the geometry.
        inertial: file and line of mass and inertia.
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
    """Placement of a body relative to its parent.

    Attributes:
        name: name of the joint in a URDF, of the child body in other formats.
        position: (3,) of the child in the parent's frame at the reference pose, m.
        rotation: (3, 3) child to parent at the reference pose.
        rpy: (3,) roll, pitch and yaw as stated, rad; None if the format states no angles.
    """

    name: str
    place: Place
    parent: str
    child: str
    position: Vector
    rotation: Vector
    rpy: Vector | None = None


@dataclass(slots=True)
class Placement:
    """Roll, pitch and yaw of an inertial frame or a shape, as stated.

    Attributes:
        rpy: (3,) rad.
    """

    place: Place
    element: str
    rpy: Vector


@dataclass(slots=True)
class Joint:
    """A joint, with one or more degrees of freedom, between a body and its parent.

    Attributes:
        body: the body that it moves.
        axis: (3,) unit vector in the body's frame.
        anchor: (3,) in the body's frame, m.
        axis_stated: (3,) axis as in the file, None if the file states none.
        lower, upper: rad or m, None if not stated.
        is_limited: whether ``lower`` and ``upper`` limit the motion.
        is_continuous: whether the joint turns without limit.
        velocity: largest speed, rad/s or m/s, None if not stated.
        effort: largest torque or force, N*m or N, None if not stated.
        damping: N*m*s/rad or N*s/m, None if not stated.
        friction: Coulomb friction, N*m or N, None if not stated.
        reference: position at the reference pose, rad or m.
        has_stated_limit: whether there is a ``limit`` element.
        idle_range: (lower, upper) stated at a continuous joint, where they have no effect, rad.
        soft: (lower, upper) of a safety controller, rad or m; 0 if it states none.
        has_stated_soft_limit: whether the safety controller states soft limits.
        soft_gain: k_velocity of the safety controller, N*m*s/rad or N*s/m.
        soft_place: file and line of the safety controller.
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

    @property
    def unit(self) -> str:
        """Return the unit of its position."""
        return "m" if self.kind == "slide" else "rad"

    @property
    def effort_unit(self) -> str:
        """Return the unit of its force or torque."""
        return "N" if self.kind == "slide" else "N*m"

    @property
    def is_scalar(self) -> bool:
        """Whether its position is one number."""
        return self.kind in ("hinge", "slide")

    @property
    def dof(self) -> int:
        """Return the number of degrees of freedom."""
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


@dataclass(slots=True)
class Coupling:
    """An equality constraint or tendon that is not a plain mimic joint."""

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
        position: (3,) in the body's frame, m.
        rotation: (3, 3) shape to body.
        file: file of a mesh.
        scale: (3,) scale of a mesh as stated.
        masks: contype and conaffinity of MuJoCo; None where the format has no masks.
        is_paired: whether an explicit contact pair contains it.
        triangles: triangles of a mesh, scaled, m; None for primitives and unreadable meshes.
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
    masks: tuple[int, int] | None = None
    is_paired: bool = False


@dataclass(slots=True)
class Transmission:
    """Transmission between actuators and joints.

    Attributes:
        reductions: reductions of joints and actuators, as stated.
        interfaces: hardware interface of each joint.
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
    """An actuator of a simulation model.

    Attributes:
        joints: joints that it drives.
        means: quantity of its command (``torque``, ``position setpoint``), None if undetermined.
        lower, upper: limits of the command, None if unlimited.
        force: largest force or torque at its output, None if unlimited.
        gear: ratio of generalized force to command.
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
    """A sensor and the link or joint that carries it."""

    place: Place
    name: str
    kind: str
    carrier: str
    rate: float | None = None


@dataclass(slots=True)
class ControlledJoint:
    """A joint of a ``ros2_control`` element and its interfaces."""

    place: Place
    system: str
    joint: str
    commands: tuple[str, ...]
    states: tuple[str, ...]


@dataclass
class Asset:
    """Content of a robot's file and of the files that it refers to.

    Attributes:
        kind: ``urdf``, ``mjcf`` or ``usd``.
        named: (kind, name, place) of all elements whose names have to differ.
        sites: named frames other than bodies: name -> (body, position (3,) [m], place).
        poses: poses that the file declares (keyframes): name -> joint -> rad or m.
        custom: elements and attributes that no format defines: path -> places.
        files: every file that was read.
        located: folders that may contain its files, None for the default.
        unseen: layer that was not audited -> reason.
        constrained: degrees of freedom that active constraints remove, followers and closed chains;
            None where the format states no constraints, or they could not be counted.
    """

    kind: Literal["urdf", "mjcf", "usd"]
    path: Path
    name: str
    root: Node | None = None
    bodies: list[Body] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    placements: list[Placement] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    mimics: list[Mimic] = field(default_factory=list)
    couplings: list[Coupling] = field(default_factory=list)
    shapes: list[Shape] = field(default_factory=list)
    transmissions: list[Transmission] = field(default_factory=list)
    actuators: list[Actuator] = field(default_factory=list)
    sensors: list[Sensor] = field(default_factory=list)
    controlled: list[ControlledJoint] = field(default_factory=list)
    named: list[tuple[str, str, Place]] = field(default_factory=list)
    sites: dict[str, tuple[str, Vector, Place]] = field(default_factory=dict)
    poses: dict[str, dict[str, float]] = field(default_factory=dict)
    custom: dict[str, list[Place]] = field(default_factory=dict)
    faults: list[Finding] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    located: ModelFolders | None = None
    unseen: dict[str, str] = field(default_factory=dict)
    constrained: int | None = None

    @property
    def place(self) -> Place:
        """Return file and line of the root element."""
        return Place(self.path, None if self.root is None else self.root.line)

    @cached_property
    def body(self) -> dict[str, Body]:
        """Return name -> body, the first of each name."""
        found: dict[str, Body] = {}
        for body in self.bodies:
            found.setdefault(body.name, body)
        return found

    @cached_property
    def joint(self) -> dict[str, Joint]:
        """Return name -> joint, the first of each name."""
        found: dict[str, Joint] = {}
        for joint in self.joints:
            found.setdefault(joint.name, joint)
        return found

    @cached_property
    def joints_of(self) -> dict[str, list[Joint]]:
        """Return body -> joints between it and its parent."""
        found: dict[str, list[Joint]] = {}
        for joint in self.joints:
            found.setdefault(joint.body, []).append(joint)
        return found

    @cached_property
    def below(self) -> dict[str, list[Edge]]:
        """Return body -> edges to its children."""
        found: dict[str, list[Edge]] = {}
        for edge in self.edges:
            found.setdefault(edge.parent, []).append(edge)
        return found

    @cached_property
    def above(self) -> dict[str, Edge]:
        """Return body -> first edge to its parent."""
        found: dict[str, Edge] = {}
        for edge in self.edges:
            found.setdefault(edge.child, edge)
        return found

    @cached_property
    def roots(self) -> list[str]:
        """Return the bodies without a parent."""
        return [name for name in self.body if name not in self.above]

    def in_order(self) -> Iterator[Edge]:
        """Yield edges from the roots to the leaves, each body once."""
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
        """Return body -> (3,) position [m] and (3, 3) rotation in its root, reference pose."""
        return self.at({})

    def at(self, values: Mapping[str, float]) -> dict[str, tuple[Vector, Vector]]:
        """Return body -> position and rotation in its root, with joints at ``values``.

        Args:
            values: joint -> rad (hinges) or m (slides); other joints keep the reference pose.
        """
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
        """Return body -> topmost body to which it is rigidly fixed."""
        found = {name: name for name in self.body}
        for edge in self.in_order():
            if not self.joints_of.get(edge.child):
                found[edge.child] = found[edge.parent]
        return found

    @cached_property
    def moving(self) -> set[str]:
        """Return the topmost bodies of rigid groups that a joint moves."""
        return {name for name in set(self.group.values()) if self.joints_of.get(name)}

    @cached_property
    def span(self) -> float:
        """Return the length of the longest path from a root to a body along the tree, m."""
        length = dict.fromkeys(self.roots, 0.0)
        for edge in self.in_order():
            length[edge.child] = length[edge.parent] + float(np.linalg.norm(edge.position))
        return max(length.values(), default=0.0)

    @cached_property
    def subtrees(self) -> dict[str, tuple[float, float]]:
        """Return body -> mass of its subtree, kg, and length of the longest path in it, m."""
        found = {name: (self.body[name].mass or 0.0, 0.0) for name in self.drawn}
        for edge in reversed(list(self.in_order())):
            mass, reach = found[edge.parent]
            carried, further = found[edge.child]
            further += float(np.linalg.norm(edge.position))
            found[edge.parent] = (mass + carried, max(reach, further))
        return found

    def shapes_of(self, body: str) -> list[Shape]:
        """Return the geometries of a body."""
        return self._shapes_by_body.get(body, [])

    @cached_property
    def _shapes_by_body(self) -> dict[str, list[Shape]]:
        found: dict[str, list[Shape]] = {}
        for shape in self.shapes:
            found.setdefault(shape.body, []).append(shape)
        return found
