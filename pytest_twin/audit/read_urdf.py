"""Read a URDF for the audit: unreadable elements become findings, the rest is still audited."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pytest_twin.asset.stated_elements import stated_elements
from pytest_twin.audit.asset import (
    Asset,
    Body,
    ControlledJoint,
    Edge,
    Joint,
    JointKind,
    Mimic,
    Placement,
    Sensor,
    Shape,
    Transmission,
)
from pytest_twin.audit.finding import Place, finding_of, from_error
from pytest_twin.audit.mesh_files import MeshFiles
from pytest_twin.errors import FormatError, ModelError, PointerError, TwinError
from pytest_twin.realization import urdf
from pytest_twin.realization.files.locate import ModelFolders
from pytest_twin.realization.files.urdf import UrdfFiles
from pytest_twin.realization.limits import LIMITS
from pytest_twin.realization.node import Node
from pytest_twin.realization.urdf_compiler import UrdfCompiler
from pytest_twin.realization.urdf_spec import mesh_file

_OF_SRDF = frozenset({"group", "group_state", "disable_collisions", "end_effector"})
_KINDS: Mapping[str, JointKind] = {
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "slide",
    "planar": "planar",
    "floating": "free",
}


def read(
    path: Path,
    located: ModelFolders,
) -> Asset:
    """Read a URDF file and its meshes.

    Args:
        located: folders that may contain meshes.

    Raises:
        FormatError: not well-formed, or a limit is exceeded.
        ModelError: not a URDF, or without a link.
    """
    root = urdf.document(path)
    if not root.all("link"):
        srdf = next((node for node in root.children if node.tag in _OF_SRDF), None)
        if srdf is not None:
            raise srdf.error(
                "an SRDF, not a URDF",
                expected="a URDF; to audit the SRDF, add --urdf FILE or name it *.srdf",
            )
        raise root.error("a robot without links", expected="at least one <link>")
    return _Reader(root, path, located).asset()


class _Reader:
    def __init__(
        self,
        root: Node,
        path: Path,
        located: ModelFolders,
    ) -> None:
        self.root = root
        self.compiler = UrdfCompiler.of(root)
        self.mesh_paths = UrdfFiles.of(root, located.roots, located.packages)
        self.meshes = MeshFiles()
        self.out = Asset("urdf", path, root.attributes.get("name", ""), root)
        self.out.located = located
        self.out.files = [path]

    def asset(self) -> Asset:
        for node in self.root.all("link"):
            self._link(node)
        for node in self.root.all("joint"):
            self._joint(node)
        ends = [(edge.parent, edge.child) for edge in self.out.edges]
        urdf.check_depth(self.root, ends, LIMITS.audited_link_depth)
        for node in self.root.all("transmission"):
            self._transmission(node)
        for node in self.root.all("ros2_control"):
            self._ros2_control(node)
        for one in stated_elements(self.root):
            if one.entry is None:
                self.out.custom.setdefault(one.label, []).append(_place(one.node))
        self._sensors()
        self.out.files += sorted({s.file for s in self.out.shapes if s.file is not None})
        return self.out

    def fault(
        self, error: TwinError, code: str, element: str, node: Node | None = None, why: str = ""
    ) -> None:
        if error.path is None and node is not None:
            error.path, error.line = node.path, node.line
        self.out.faults.append(from_error(error, code, element, why=why))

    # -- links

    def _link(self, node: Node) -> None:
        name = node.attributes.get("name", "")
        place = _place(node)
        if not name.strip():
            self.fault(node.error("no name", "name", expected="a name"), "tree.unreadable", "link")
            return
        self.out.named.append(("link", name, place))
        inertial = node.find("inertial")
        body = Body(name, place, inertial=None if inertial is None else _place(inertial))
        if inertial is not None:
            self._placement(inertial, f"inertial of link '{name}'")
            try:
                link = self.compiler.corrected(urdf.link_of(node))
            except (ModelError, FormatError) as error:
                self.fault(error, "inertia.unreadable", node.label)
            else:
                body.mass, body.com, body.inertia = link.mass, link.com, link.inertia
                if inertial.find("mass") is None:
                    body.mass = None
                if inertial.find("inertia") is None:
                    body.inertia = None
        self.out.bodies.append(body)
        for tag in ("visual", "collision"):
            for child in node.all(tag):
                self._shape(name, tag, child)

    def _shape(self, link: str, role: str, node: Node) -> None:
        element = f"{role} of link '{link}'"
        try:
            shape = self._geometry(link, role, node)
        except (ModelError, FormatError) as error:
            self.fault(error, "meshes.unreadable", element)
            return
        if shape.kind == "mesh":
            geometry = node.find("geometry")
            mesh_node = None if geometry is None else geometry.find("mesh")
            assert mesh_node is not None
            self._mesh(shape, mesh_node, element)
        self.out.shapes.append(shape)

    def _geometry(self, link: str, role: str, node: Node) -> Shape:
        geometry = node.find("geometry")
        kinds = [] if geometry is None else geometry.children
        if len(kinds) != 1:
            raise node.error(f"{len(kinds)} shapes in one geometry", expected="one")
        position, rotation = urdf.origin(node)
        self._placement(node, f"{role} of link '{link}'")
        found = kinds[0]
        size: tuple[float, ...]
        scale = np.ones(3)
        if found.tag == "box":
            size = tuple(found.numbers("size", None, size=3, unit="m"))
        elif found.tag in ("cylinder", "capsule"):
            size = (
                found.number("radius", None, unit="m"),
                found.number("length", None, unit="m"),
            )
        elif found.tag == "sphere":
            size = (found.number("radius", None, unit="m"),)
        elif found.tag == "mesh":
            size = ()
            scale = found.numbers("scale", (1.0, 1.0, 1.0))
        else:
            raise found.error("no known shape", expected="box, cylinder, capsule, sphere or mesh")
        return Shape(
            _place(found),
            link,
            "visual" if role == "visual" else "collision",
            found.tag,
            position,
            rotation,
            tuple(float(value) for value in size),
            scale=scale,
        )

    def _placement(self, node: Node, element: str) -> None:
        origin = node.find("origin")
        if origin is None or "rpy" not in origin.attributes:
            return
        with contextlib.suppress(ModelError):  # reported with the element that it places
            rpy = origin.numbers("rpy", (0.0, 0.0, 0.0))
            self.out.placements.append(Placement(_place(origin), element, rpy))

    def _mesh(self, shape: Shape, node: Node, element: str) -> None:
        try:
            shape.file = mesh_file(node, self.mesh_paths)
        except TwinError as error:
            escapes = "leaves the declared roots" in error.problem or "URL" in error.problem
            self.out.faults.append(
                from_error(
                    error,
                    "meshes.escapes" if escapes else "meshes.missing",
                    element,
                    # A visual mesh does not affect motion, so it is omitted wherever it is.
                    severity="critical" if shape.role == "collision" else "warning",
                    why="without this shape the link collides with nothing"
                    if shape.role == "collision"
                    else "viewers refuse the robot or show it without this part",
                    settle="put the file into the model's folder and name it by a relative path",
                )
            )
            return
        try:
            if (shape.scale == 0).any():
                raise node.error("a mesh without size", "scale", expected="factors other than 0")
            shape.triangles = self.meshes.read(shape.file).scaled(shape.scale)
        except TwinError as error:
            self.out.faults.append(
                finding_of(
                    "meshes.unreadable",
                    _place(node),
                    element,
                    None if error.value is None else str(error.value),
                    severity="critical" if shape.role == "collision" else "warning",
                    title=f"{shape.file.name}: {error.problem}",
                    unit=error.unit,
                    expected=error.expected,
                    settle=str(error.expected).partition(": ")[2]
                    if isinstance(error, PointerError)
                    else f"export {shape.file.name} again from CAD",
                )
            )

    # -- joints

    def _joint(self, node: Node) -> None:
        name = node.attributes.get("name", "")
        place = _place(node)
        if name.strip():
            self.out.named.append(("joint", name, place))
        try:
            joint = urdf.joint_of(node)
        except (ModelError, FormatError) as error:
            self.fault(error, "joints.unreadable", node.label)
            self._edge_alone(node, name, place)
            return
        origin = node.find("origin")
        rpy = np.zeros(3) if origin is None else origin.numbers("rpy", (0.0, 0.0, 0.0))
        self.out.edges.append(
            Edge(name, place, joint.parent, joint.child, joint.position, joint.rotation, rpy)
        )
        if joint.type == "fixed":
            return
        axis_node = node.find("axis")
        stated = None if axis_node is None else axis_node.numbers("xyz", (1.0, 0.0, 0.0))
        lower, upper = joint.limits or (None, None)
        dynamics, safety = node.find("dynamics"), node.find("safety_controller")
        stated_dynamics = set() if dynamics is None else set(dynamics.attributes)
        made = Joint(
            name,
            place,
            _KINDS[joint.type],
            joint.child,
            joint.axis,
            axis_stated=stated,
            lower=lower,
            upper=upper,
            is_limited=joint.limits is not None,
            is_continuous=joint.type == "continuous",
            velocity=joint.velocity,
            effort=joint.effort,
            damping=joint.damping if "damping" in stated_dynamics else None,
            friction=joint.friction if "friction" in stated_dynamics else None,
            has_stated_limit=node.find("limit") is not None,
            idle_range=self._idle_range(node, joint),
        )
        if safety is not None:
            self._safety(safety, made)
        self.out.joints.append(made)
        if joint.mimic is not None:
            self.out.mimics.append(
                Mimic(
                    _place(joint.mimic.node),
                    name,
                    joint.mimic.joint,
                    joint.mimic.multiplier,
                    joint.mimic.offset,
                )
            )

    def _edge_alone(self, node: Node, name: str, place: Place) -> None:
        """Add the edge of a joint whose numbers cannot be read."""
        ends = [node.find(end) for end in ("parent", "child")]
        links = ["" if end is None else end.attributes.get("link", "") for end in ends]
        if all(links):
            try:
                position, rotation = urdf.origin(node)
            except ModelError:
                position, rotation = np.zeros(3), np.eye(3)
            self.out.edges.append(Edge(name, place, links[0], links[1], position, rotation))

    def _idle_range(self, node: Node, joint: urdf.Joint) -> tuple[float, float] | None:
        """Return the limits stated at a continuous joint, which no parser applies, rad."""
        limit = node.find("limit")
        if joint.type != "continuous" or limit is None:
            return None
        if not {"lower", "upper"} & set(limit.attributes):
            return None
        try:
            return (
                limit.number("lower", 0.0, unit="rad", most=math.inf),
                limit.number("upper", 0.0, unit="rad", most=math.inf),
            )
        except ModelError as error:
            self.fault(error, "joints.unreadable", node.label)
            return None

    def _safety(self, node: Node, joint: Joint) -> None:
        joint.soft_place = _place(node)
        keys = ("soft_lower_limit", "soft_upper_limit")
        try:
            low, high = (node.number(key, 0.0, unit=joint.unit, most=math.inf) for key in keys)
            if "k_velocity" in node.attributes:
                joint.soft_gain = node.number("k_velocity", None, most=math.inf)
        except ModelError as error:
            self.fault(error, "controllers.unreadable", f"joint '{joint.name}'", node)
            return
        joint.soft = (low, high)
        joint.has_stated_soft_limit = set(keys) <= set(node.attributes)

    # -- what drives and senses

    def _transmission(self, node: Node) -> None:
        name = node.attributes.get("name", "")
        place = _place(node)
        if name:
            self.out.named.append(("transmission", name, place))
        kind = node.find("type")
        joints, actuators = node.all("joint"), node.all("actuator")
        reductions: list[float] = []
        for part in (*joints, *actuators, node):
            # The old form is an attribute of the joint, the new one an element of the actuator.
            for child in part.children:
                if child.tag == "mechanicalReduction":
                    reductions += self._text_number(child, name)
        interfaces = tuple(
            child.text for part in (*joints, *actuators) for child in part.all("hardwareInterface")
        )
        self.out.transmissions.append(
            Transmission(
                place,
                name,
                node.attributes.get("type", "") if kind is None else kind.text,
                tuple(joint.attributes.get("name", "") for joint in joints),
                tuple(actuator.attributes.get("name", "") for actuator in actuators),
                tuple(reductions),
                tuple(interface for interface in interfaces if interface),
            )
        )

    def _text_number(self, node: Node, name: str) -> list[float]:
        try:
            value = float(node.text)
        except ValueError:
            value = math.nan
        if math.isfinite(value):
            return [value]
        self.fault(
            node.error("no number", value=node.text, expected="a finite reduction"),
            "transmissions.unreadable",
            f"transmission '{name}'",
        )
        return []

    def _ros2_control(self, node: Node) -> None:
        system = node.attributes.get("name", "")
        for joint in node.all("joint"):
            self.out.controlled.append(
                ControlledJoint(
                    _place(joint),
                    system,
                    joint.attributes.get("name", ""),
                    tuple(c.attributes.get("name", "") for c in joint.all("command_interface")),
                    tuple(c.attributes.get("name", "") for c in joint.all("state_interface")),
                )
            )

    def _sensors(self) -> None:
        for top in self.root.children:
            for node in top.walk():
                if node.tag != "sensor":
                    continue
                parent = node.find("parent")
                carrier = top.attributes.get("reference", "")
                if top.tag == "link":
                    carrier = top.attributes.get("name", "")
                elif parent is not None:
                    carrier = parent.attributes.get("link", "") or parent.attributes.get(
                        "joint", ""
                    )
                rate_node = node.find("update_rate")
                text = (
                    node.attributes.get("update_rate", "")
                    if rate_node is None
                    else (rate_node.text)
                )
                try:
                    rate = float(text) if text else None
                except ValueError:
                    rate = None
                self.out.sensors.append(
                    Sensor(
                        _place(node),
                        node.attributes.get("name", ""),
                        node.attributes.get("type", ""),
                        carrier,
                        rate if rate is None or math.isfinite(rate) else None,
                    )
                )


def _place(node: Node) -> Place:
    return Place(node.path, node.line)
