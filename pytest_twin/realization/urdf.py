"""Read and check a URDF file: links, joints and their tree."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import FormatError, require_at_most
from pytest_twin.formats import xml
from pytest_twin.formats.declared_inputs import expansion_of
from pytest_twin.formats.expansions import SUFFIX, model_stem
from pytest_twin.realization import inertia, urdf_orientation
from pytest_twin.realization.limits import LIMITS
from pytest_twin.realization.node import Node
from pytest_twin.realization.urdf_compiler import UrdfCompiler

Vector = NDArray[np.float64]
MOVING = ("revolute", "continuous", "prismatic", "planar", "floating")


@dataclass(slots=True)
class Link:
    """A rigid body.

    Attributes:
        node: the ``link`` element.
        mass: kg.
        com: (3,) centre of mass in the link's frame, m.
        inertia: (3, 3) about the centre of mass, link axes, kg*m^2.
        inertial: the ``inertial`` element, or None.
    """

    name: str
    node: Node
    mass: float
    com: Vector
    inertia: Vector
    inertial: Node | None


@dataclass(slots=True)
class Mimic:
    """Coupling to another joint: ``value = multiplier * joint + offset``, offset in rad or m."""

    node: Node
    joint: str
    multiplier: float
    offset: float


@dataclass(slots=True)
class Joint:
    """Joint between a parent link and a child link.

    Attributes:
        node: the ``joint`` element.
        type: ``revolute``, ``continuous``, ``prismatic``, ``planar``, ``floating`` or ``fixed``.
        position: (3,) position of the child's frame in the parent's, m.
        rotation: (3, 3) orientation of the child's frame in the parent's.
        axis: (3,) unit vector in the child's frame.
        limits: (lower, upper), rad or m, None where not stated.
        velocity, effort: limits, rad/s or m/s, N*m or N; None where not stated.
        damping: N*m*s/rad or N*s/m.
        friction: N*m or N.
        mimic: coupling to another joint, or None.
    """

    name: str
    node: Node
    type: str
    parent: str
    child: str
    position: Vector
    rotation: Vector
    axis: Vector
    limits: tuple[float, float] | None
    velocity: float | None
    effort: float | None
    damping: float
    friction: float
    mimic: Mimic | None


@dataclass(slots=True)
class Robot:
    """A tree of links.

    Attributes:
        node: the ``robot`` element.
        root: the link without a parent.
        links: in the order of the file.
        joints: in the order of the file.
        children: link -> joints whose parent it is.
        lost_mimics: joint -> its mimic of a joint that does not exist; its ``mimic`` is then None.
        compiler: settings of the file for MuJoCo's compiler.
        corrected: links whose mass or inertia these settings change.
    """

    node: Node
    root: str
    links: dict[str, Link]
    joints: dict[str, Joint]
    children: dict[str, list[Joint]] = field(default_factory=dict)
    lost_mimics: dict[str, Mimic] = field(default_factory=dict)
    compiler: UrdfCompiler = field(default_factory=UrdfCompiler)
    corrected: set[str] = field(default_factory=set)

    def in_order(self) -> list[Joint]:
        """Joints, each after the joints between it and the root."""
        found: list[Joint] = []
        waiting = list(reversed(self.children[self.root]))
        while waiting:
            joint = waiting.pop()
            found.append(joint)
            waiting.extend(reversed(self.children[joint.child]))
        return found


def read(path: Path) -> Robot:
    """Read a URDF file; its mesh files are not opened.

    Raises:
        FormatError: not well-formed, or larger than a limit.
        ModelError: not a tree of links, or an invalid value.
    """
    root = document(path)
    links: dict[str, Link] = {}
    compiler = UrdfCompiler.of(root)
    corrected: set[str] = set()
    for node in root.all("link"):
        stated = link_of(node)
        link = compiler.corrected(stated)
        if link is not stated:
            corrected.add(link.name)
        if link.name in links:
            raise node.error(
                "two links of one name",
                "name",
                expected=f"unlike line {links[link.name].node.line}",
            )
        links[link.name] = link
    if not links:
        raise root.error(
            "a robot without links", expected="at least one link; expand a xacro file first"
        )
    joints: dict[str, Joint] = {}
    for node in root.all("joint"):
        joint = joint_of(node)
        if joint.name in joints:
            raise node.error(
                "two joints of one name",
                "name",
                expected=f"unlike line {joints[joint.name].node.line}",
            )
        joints[joint.name] = joint
    check_depth(root, [(joint.parent, joint.child) for joint in joints.values()], LIMITS.link_depth)
    robot = Robot(root, "", links, joints, {name: [] for name in links}, compiler=compiler)
    robot.corrected.update(corrected)
    _check_tree(robot)
    _remove_lost_mimics(robot)
    _check_mimics(robot)
    return robot


def check_depth(robot: Node, ends: Iterable[tuple[str, str]], most: int) -> None:
    """Check the depth of the tree of links.

    Args:
        robot: the ``robot`` element.
        ends: parent and child of each joint.
        most: largest number of links from the root to a leaf, including both.

    Raises:
        LimitError: the tree is deeper.
    """
    children: dict[str, list[str]] = {}
    below: set[str] = set()
    for parent, child in ends:
        children.setdefault(parent, []).append(child)
        below.add(child)
    level = [name for name in children if name not in below]
    reached = set(level)
    depth = 0
    while level:
        depth += 1
        found = (child for name in level for child in children.get(name, ()))
        level = [name for name in dict.fromkeys(found) if name not in reached]
        reached.update(level)
    if depth > most:
        raise robot.limit(
            "too many links one below the other",
            value=depth,
            unit="links in one chain",
            expected=f"at most {most}",
        )


_SUBSTITUTION = re.compile(r"\$\((?:arg|env|optenv|eval|dirname)\b|\$\{")
"""Substitutions of xacro beside ``$(find PACKAGE)``, which is resolved without xacro."""


def document(path: Path) -> Node:
    """The ``robot`` element of a URDF file; its values are not checked.

    Raises:
        FormatError: not well-formed, or larger than a limit.
        ModelError: not a URDF, or a quaternion that states no orientation.
    """
    if path.suffix == SUFFIX and expansion_of(path) is None:
        raise FormatError(
            "a xacro file, not a URDF",
            path=path,
            expected=f"pytest-twin realize {path.name} --out DIR, or the URDF that xacro writes: "
            f"xacro {path.name} > {model_stem(path)}.urdf",
        )
    root = _nodes(urdf_orientation.parse(path)[0], path)
    if root.tag != "robot":
        raise root.error("not a URDF", value=root.tag, expected="the root <robot>")
    if not root.all("link"):
        for node in root.walk():
            if node.tag.startswith("xacro:"):
                raise node.error("a xacro macro, not a URDF", expected="the output of `xacro`")
    _refuse_substitutions(root)
    return root


def _refuse_substitutions(robot: Node) -> None:
    """Refuse a part of a xacro file, whose paths and numbers only the whole file gives."""
    for part in (*robot.all("link"), *robot.all("joint")):
        for node in part.walk():
            for name, value in node.attributes.items():
                if _SUBSTITUTION.search(value):
                    raise node.error(
                        "a substitution of xacro, not a URDF",
                        name,
                        value=value,
                        expected="the xacro file that includes this one (--xacro ARG:=VALUE gives "
                        "an argument), or the output of `xacro`",
                    )


def rotation(rpy: Vector) -> Vector:
    """(3, 3) rotation matrix of (3,) roll, pitch, yaw [rad] about fixed axes: R_z(yaw) R_y(pitch)
    R_x(roll).
    """
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def origin(node: Node) -> tuple[Vector, Vector]:
    """(3,) position [m] and (3, 3) orientation in the ``origin`` element below ``node``."""
    element = node.find("origin")
    if element is None:
        return np.zeros(3), np.eye(3)
    position = element.numbers("xyz", (0.0, 0.0, 0.0), unit="m")
    return position, rotation(element.numbers("rpy", (0.0, 0.0, 0.0), unit="rad"))


def _nodes(root: xml.Element, path: Path) -> Node:
    count = 0

    def node(element: Any) -> Node:
        nonlocal count
        count += 1
        require_at_most(count, LIMITS.elements, "too many elements", path=path)
        return Node(
            xml.plain_name(str(element.tag), element),
            {xml.plain_name(str(k), element): str(v) for k, v in element.attrib.items()},
            path,
            element.sourceline or 1,
            [node(child) for child in element if isinstance(child.tag, str)],
            (element.text or "").strip(),
        )

    return node(root)


def _name(node: Node) -> str:
    name = node.attributes.get("name", "")
    if not name.strip():
        raise node.error("no name", "name", expected="a name")
    return name


def link_of(node: Node) -> Link:
    """Parse a ``link`` element.

    Raises:
        ModelError: an invalid value.
    """
    name = _name(node)
    inertial = node.find("inertial")
    if inertial is None:
        return Link(name, node, 0.0, np.zeros(3), np.zeros((3, 3)), None)
    com, axes = origin(inertial)
    mass_node, inertia_node = inertial.find("mass"), inertial.find("inertia")
    mass = 0.0 if mass_node is None else mass_node.number("value", None, unit="kg")
    if mass < 0 and mass_node is not None:
        raise mass_node.error(
            f"link '{name}' has a negative mass",
            "value",
            value=mass,
            unit="kg",
            expected="0 or more",
        )
    moments = np.zeros((3, 3))
    if inertia_node is not None:
        keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        values = tuple(inertia_node.number(key, 0.0, unit="kg*m^2") for key in keys)
        moments = axes @ inertia.tensor(values) @ axes.T
    return Link(name, node, mass, com, moments, inertial)


def joint_of(node: Node) -> Joint:
    """Parse a ``joint`` element; the links that it names are not checked.

    Raises:
        ModelError: an invalid value.
    """
    name = _name(node)
    kind = node.attributes.get("type", "")
    if kind not in (*MOVING, "fixed"):
        raise node.error(
            "no such type of joint", "type", value=kind, expected=", ".join((*MOVING, "fixed"))
        )
    ends = {}
    for end in ("parent", "child"):
        element = node.find(end)
        if element is None or not element.attributes.get("link"):
            raise node.error("no link", end, expected=f"<{end} link='...'/>")
        ends[end] = element.attributes["link"]
    position, axes = origin(node)
    linear = kind == "prismatic"
    axis_node = node.find("axis")
    axis = np.array([1.0, 0.0, 0.0])
    if axis_node is not None and kind not in ("fixed", "floating"):
        axis = axis_node.numbers("xyz", (1.0, 0.0, 0.0))
        length = float(np.linalg.norm(axis))
        if length < 1e-6:
            raise axis_node.error(
                f"joint '{name}' has an axis without direction",
                "xyz",
                value=length,
                expected="a vector such as 0 0 1",
            )
        axis = axis / length
    velocity = effort = None
    limits = None
    limit = node.find("limit")
    if limit is not None and kind != "fixed":
        unit = "m" if linear else "rad"
        if kind in ("revolute", "prismatic") and {"lower", "upper"} & set(limit.attributes):
            lower = limit.number("lower", 0.0, unit=unit, most=math.inf)
            upper = limit.number("upper", 0.0, unit=unit, most=math.inf)
            if lower > upper:
                raise limit.error(
                    f"joint '{name}' has its lower limit above its upper",
                    "lower",
                    value=f"{lower:g} > {upper:g}",
                    unit=unit,
                    expected="lower below upper",
                )
            limits = (lower, upper)
        velocity = _not_negative(limit, "velocity", f"{unit}/s", name)
        effort = _not_negative(limit, "effort", "N" if linear else "N*m", name)
    dynamics = node.find("dynamics")
    damping = friction = 0.0
    if dynamics is not None:
        unit = "N*s/m" if linear else "N*m*s/rad"
        damping = _not_negative(dynamics, "damping", unit, name) or 0.0
        friction = _not_negative(dynamics, "friction", "N" if linear else "N*m", name) or 0.0
    return Joint(
        name,
        node,
        kind,
        ends["parent"],
        ends["child"],
        position,
        axes,
        axis,
        limits,
        velocity,
        effort,
        damping,
        friction,
        _mimic(node),
    )


def _not_negative(node: Node, attribute: str, unit: str, joint: str) -> float | None:
    if attribute not in node.attributes:
        return None
    # Some files state 1e30 for an unlimited value.
    value = node.number(attribute, None, unit=unit, most=math.inf)
    if value < 0:
        raise node.error(
            f"joint '{joint}' has a negative {attribute}",
            attribute,
            value=value,
            unit=unit,
            expected="0 or more",
        )
    return value


def _mimic(node: Node) -> Mimic | None:
    mimic = node.find("mimic")
    if mimic is None:
        return None
    joint = mimic.attributes.get("joint", "")
    if not joint:
        raise mimic.error("no joint", "joint", expected="the joint that is followed")
    return Mimic(mimic, joint, mimic.number("multiplier", 1.0), mimic.number("offset", 0.0))


def _check_tree(robot: Robot) -> None:
    parent_of: dict[str, Joint] = {}
    for joint in robot.joints.values():
        for end in (joint.parent, joint.child):
            if end not in robot.links:
                raise joint.node.error(
                    "no such link", value=end, expected="the name of a link of this robot"
                )
        if joint.child in parent_of:
            other = parent_of[joint.child]
            raise joint.node.error(
                f"link '{joint.child}' is already attached to joint '{other.name}'",
                value=f"lines {other.node.line} and {joint.node.line}",
                expected="one parent for each link",
            )
        parent_of[joint.child] = joint
        robot.children[joint.parent].append(joint)
    roots = [name for name in robot.links if name not in parent_of]
    if len(roots) != 1:
        found = ", ".join(f"'{name}'" for name in roots[:6])
        raise robot.node.error(
            "the links do not form a single tree",
            value=f"{len(roots)} roots" + (f": {found}" if roots else ", a loop"),
            expected="one link without a parent",
        )
    robot.root = roots[0]
    reached = len(robot.in_order()) + 1
    if reached != len(robot.links):
        raise robot.node.error(
            "a loop of links that is not connected to the root",
            value=f"{len(robot.links) - reached} links",
            expected="every link on a chain of joints from the root",
        )


def _remove_lost_mimics(robot: Robot) -> None:
    """Move mimics of joints that do not exist to ``lost_mimics``.

    MuJoCo and Pinocchio load such a robot and ignore the mimic.
    """
    for joint in robot.joints.values():
        if joint.mimic is not None and joint.mimic.joint not in robot.joints:
            robot.lost_mimics[joint.name] = joint.mimic
            joint.mimic = None


def _check_mimics(robot: Robot) -> None:
    for joint in robot.joints.values():
        if joint.mimic is None or joint.type == "fixed":
            continue
        if joint.type not in ("revolute", "continuous", "prismatic"):
            raise joint.mimic.node.error(
                f"a {joint.type} joint cannot follow another",
                expected="a revolute, continuous or prismatic joint",
            )
        seen = [joint.name]
        follower = joint
        while follower.mimic is not None:
            leader = robot.joints[follower.mimic.joint]
            if leader.type == "fixed":
                break
            if leader.type not in ("revolute", "continuous", "prismatic"):
                raise follower.mimic.node.error(
                    f"a {leader.type} joint cannot be followed",
                    value=leader.name,
                    expected="a revolute, continuous or prismatic joint",
                )
            if leader.name in seen:
                raise follower.mimic.node.error(
                    "joints follow each other in a circle",
                    value=" -> ".join((*seen, leader.name)),
                    expected="one joint that follows none",
                )
            seen.append(leader.name)
            follower = leader


def principal_text(moments: Vector) -> str:
    """Principal moments of a (3, 3) inertia as text."""
    return ", ".join(f"{m:.6g}" for m in np.linalg.eigvalsh(moments))
