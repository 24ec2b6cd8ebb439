"""Convert a URDF to a :class:`mujoco.MjSpec`, with a note on each change.

Where URDF defines nothing, this module applies these rules:

- The root link is fixed to the world.
- Each link is a body, also behind a fixed joint, so that the pose of every frame is available.
- A joint with an effort limit and without a mimic gets a ``motor`` with its name: a torque or force
  in N*m or N, limited by the effort. URDF describes no servo.
- A mimic joint is a stiff equality constraint.
- Collision shapes collide; visual shapes are left out. The two links of a joint do not collide with
  each other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import TwinError
from pytest_twin.realization import inertia, mesh, mjcf, urdf_orientation
from pytest_twin.realization.files.urdf import UrdfFiles
from pytest_twin.realization.limits import LIMITS
from pytest_twin.realization.node import Node
from pytest_twin.realization.urdf import Joint, Link, Robot, origin, principal_text
from pytest_twin.twin import Patch

Vector = NDArray[np.float64]

TIMESTEP = 0.002
"""Integration step of a converted model, s; MuJoCo's default."""
# Stiff and critically damped: the smallest stable time constant in MuJoCo is twice the timestep.
_MIMIC_SOLREF = (2 * TIMESTEP, 1.0)
_MIMIC_SOLIMP = (0.99, 0.9999, 0.001, 0.5, 2.0)
"""``solimp`` of a mimic constraint, stiffer than MuJoCo's default."""
# m. MuJoCo cannot build the convex hull of a thinner mesh, which becomes a box instead.
_MIN_THICKNESS = 1e-6
_BOX_THICKNESS = 1e-3
"""Smallest edge of the box that replaces a flat mesh, m."""
_MAX_EXTENT = 1e6
"""Largest coordinate of a mesh, m."""

_MAX_NAMED = 4
"""Largest number of links that a note names."""


@dataclass(slots=True)
class ConvertedSpec:
    """MuJoCo spec of a URDF.

    Attributes:
        notes: changes and omissions, one line each, with file and line.
        inertia_repairs: link -> inertia (ixx iyy izz ixy ixz iyz, kg*m^2) that replaces an
            inconsistent one.
        velocity_limit: joint -> rad/s or m/s.
        mesh_paths: name in the spec -> mesh file.
        beside: buffer files of the mesh files.
    """

    spec: mujoco.MjSpec
    notes: list[str] = field(default_factory=list)
    inertia_repairs: dict[str, tuple[float, ...]] = field(default_factory=dict)
    velocity_limit: dict[str, float] = field(default_factory=dict)
    mesh_paths: dict[str, Path] = field(default_factory=dict)
    beside: set[Path] = field(default_factory=set)


def convert(
    robot: Robot,
    files: UrdfFiles,
    *,
    accept_invalid_inertia: bool = False,
    inertia_patches: Mapping[str, Patch] | None = None,
    shapes: bool = True,
) -> ConvertedSpec:
    """Convert a URDF to a MuJoCo spec.

    Args:
        accept_invalid_inertia: whether to repair inertias that are not physically consistent and
            add a note, instead of raising an error.
        inertia_patches: link -> ``mass`` [kg], ``com`` [m], ``inertia`` [kg*m^2] of a fit.
        shapes: whether to add collision shapes; without them no mesh file is read.

    Raises:
        ModelError: an inconsistent inertia, or an invalid shape.
        PathError: a mesh file does not exist or is outside the roots.
        FormatError: an invalid mesh file.
    """
    patches = inertia_patches or {}
    return _Converter(robot, files, accept_invalid_inertia, patches, shapes).run()


class _Converter:
    def __init__(
        self,
        robot: Robot,
        files: UrdfFiles,
        accept_invalid_inertia: bool,
        inertia_patches: Mapping[str, Patch],
        shapes: bool,
    ) -> None:
        self.robot = robot
        self.files = files
        self.accept_invalid_inertia = accept_invalid_inertia
        self.inertia_patches = inertia_patches
        self.shapes = shapes
        self.spec = self._empty()
        self.out = ConvertedSpec(self.spec)
        self.bodies: dict[str, mujoco.MjsBody] = {}
        self.stated: dict[str, tuple[float, Vector, Vector]] = {}
        self.other_axes: Counter[str] = Counter()
        self.mesh_names: dict[tuple[Path, tuple[float, ...]], str] = {}
        self.triangles: dict[Path, mesh.Triangles] = {}
        self.geom_names: set[str] = set()
        self.bytes = 0
        self.faces = 0

    def note(self, node: Node, text: str) -> None:
        self.out.notes.append(f"{node.place}: {text}")

    def run(self) -> ConvertedSpec:
        spec = self.spec
        spec.modelname = self.robot.node.attributes.get("name", "robot")
        spec.compiler.degree = False
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
        self._compiler()
        self._links()
        for joint in self.robot.in_order():
            self._joint(joint)
        for joint in self.robot.in_order():
            self._mimic(joint)
            self._actuator(joint)
        self._inertias()
        for link in self.robot.links.values() if self.shapes else ():
            self._collisions(link)
        self._exclude_base()
        self._note_left_out()
        for element in urdf_orientation.ignored(self.robot.node):
            self.note(
                element,
                "quat_xyzw is ignored, as urdfdom does: the robot has no version='1.1' or higher",
            )
        return self.out

    def _empty(self) -> mujoco.MjSpec:
        """A spec with the simulation options of the URDF, and defaults for the others."""
        compiler = self.robot.compiler
        if compiler.option is not None:
            mjcf.check_values(compiler.option)
        text = compiler.option_text(timestep=f"{TIMESTEP}", integrator="implicitfast")
        try:
            return mujoco.MjSpec.from_string(text)
        except (ValueError, RuntimeError, mujoco.FatalError) as error:
            node = compiler.option or self.robot.node
            words = " ".join(str(error).split())
            raise node.error(f"MuJoCo refuses the options: {words}") from None

    def _compiler(self) -> None:
        compiler = self.robot.compiler
        for name in sorted(self.robot.corrected):
            link = self.robot.links[name]
            self.note(
                link.inertial or link.node,
                f"link '{name}' has the mass and inertia that <mujoco><compiler> asks for: "
                f"{link.mass:g} kg, {principal_text(link.inertia)} kg*m^2",
            )
        for attribute in compiler.not_applied:
            self.note(
                compiler.compiler or self.robot.node,
                f"<compiler {attribute}> is not applied: the robot has the values of its links",
            )

    # -- tree

    def _links(self) -> None:
        root = self.robot.links[self.robot.root]
        world = self.spec.worldbody
        # MuJoCo's root body has this name and is fixed too.
        self.bodies[root.name] = world if root.name == "world" else world.add_body(name=root.name)
        for joint in self.robot.in_order():
            if joint.child == "world":
                raise self.robot.links["world"].node.error(
                    "only the root may be named 'world'", expected="another name for this link"
                )
            body = self.bodies[joint.parent].add_body(name=joint.child)
            body.pos = joint.position
            body.quat = _quaternion(joint.rotation)
            body.info = f"line {self.robot.links[joint.child].node.line}"
            self.bodies[joint.child] = body

    def _joint(self, joint: Joint) -> None:
        if joint.type == "fixed":
            return
        body = self.bodies[joint.child]
        if joint.type == "floating":
            self._floating(joint, body)
        elif joint.type == "planar":
            normal = joint.axis
            first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
            first /= np.linalg.norm(first)
            for suffix, axis in (("x", first), ("y", np.cross(normal, first))):
                self._add(joint, body, f"{joint.name}_{suffix}", "mjJNT_SLIDE", axis)
            self._add(joint, body, f"{joint.name}_yaw", "mjJNT_HINGE", normal)
            self.note(joint.node, f"planar joint '{joint.name}' became joints _x, _y and _yaw")
        else:
            kind = "mjJNT_SLIDE" if joint.type == "prismatic" else "mjJNT_HINGE"
            made = self._add(joint, body, joint.name, kind, joint.axis)
            self._limit(joint, made)
        if joint.velocity is not None:
            self.out.velocity_limit[joint.name] = joint.velocity

    def _floating(self, joint: Joint, body: mujoco.MjsBody) -> None:
        if self.bodies[joint.parent].name == "world":
            body.add_joint(name=joint.name, type=mujoco.mjtJoint.mjJNT_FREE)
            return
        for suffix, axis in zip("xyz", np.eye(3), strict=True):
            self._add(joint, body, f"{joint.name}_{suffix}", "mjJNT_SLIDE", axis)
        self._add(joint, body, f"{joint.name}_ball", "mjJNT_BALL", np.array([0.0, 0.0, 1.0]))
        self.note(joint.node, f"floating joint '{joint.name}' became joints _x, _y, _z and _ball")

    def _add(
        self, joint: Joint, body: mujoco.MjsBody, name: str, kind: str, axis: Vector
    ) -> mujoco.MjsJoint:
        return body.add_joint(
            name=name,
            type=getattr(mujoco.mjtJoint, kind),
            axis=axis,
            damping=[joint.damping, 0, 0],
            frictionloss=joint.friction,
            limited=mujoco.mjtLimited.mjLIMITED_FALSE,
        )

    def _limit(self, joint: Joint, made: mujoco.MjsJoint) -> None:
        if joint.limits is None:
            if joint.type != "continuous":
                self.note(joint.node, f"joint '{joint.name}' states no range and is not limited")
            return
        lower, upper = joint.limits
        if upper - lower < 1e-9:
            # MuJoCo requires a range that is not empty.
            lower, upper = lower - 1e-9, upper + 1e-9
            self.note(joint.node, f"joint '{joint.name}' has no range and is held at {upper:.6g}")
        made.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        made.range = [lower, upper]

    def _mimic(self, joint: Joint) -> None:
        if joint.mimic is None:
            lost = self.robot.lost_mimics.get(joint.name)
            if lost is not None:
                self.note(
                    lost.node,
                    f"joint '{joint.name}' mimics '{lost.joint}', which does not exist: the mimic "
                    "is ignored",
                )
            return
        if joint.type == "fixed":
            self.note(joint.mimic.node, f"fixed joint '{joint.name}' cannot follow another")
            return
        leader = self.robot.joints[joint.mimic.joint]
        equality = self.spec.add_equality(
            name=f"{joint.name}_mimic",
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=joint.name,
            name2="" if leader.type == "fixed" else leader.name,
            solref=_MIMIC_SOLREF,
            solimp=_MIMIC_SOLIMP,
        )
        data = np.zeros_like(equality.data)
        data[:2] = joint.mimic.offset, joint.mimic.multiplier
        equality.data = data
        if leader.type == "fixed":
            self.note(
                joint.mimic.node,
                f"joint '{joint.name}' follows the fixed joint '{leader.name}': a stiff equality "
                f"holds it at its offset, {joint.mimic.offset:g}",
            )
            return
        self.note(
            joint.mimic.node,
            f"mimic of '{joint.name}' became a stiff equality with '{joint.mimic.joint}'",
        )

    def _actuator(self, joint: Joint) -> None:
        if joint.type not in ("revolute", "continuous", "prismatic") or joint.mimic is not None:
            return
        if not joint.effort:
            self.note(joint.node, f"joint '{joint.name}' states no effort and has no actuator")
            return
        bound = [-joint.effort, joint.effort]
        actuator = self.spec.add_actuator(
            name=joint.name,
            target=joint.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            ctrlrange=bound,
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=bound,
        )
        actuator.set_to_motor()
        made = self.spec.joint(joint.name)
        made.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
        made.actfrcrange = bound

    # -- inertia

    def _inertias(self) -> None:
        for link in self.robot.links.values():
            self.stated[link.name] = self._stated(link)
        moving = {joint.child for joint in self.robot.joints.values() if joint.type != "fixed"}
        raised: list[Link] = []
        for link in self.robot.links.values():
            mass, com, moments = self.stated[link.name]
            if link.name in moving and not self._has_inertia(link):
                raised.append(link)
                mass = max(mass, inertia.MASS_FLOOR)
                moments = inertia.nearest_consistent(moments, floor=inertia.MASS_FLOOR)
            body = self.bodies[link.name]
            if body.name != "world":
                inertia.write(body, mass, com, moments)
        if raised:
            self._note_raised(raised)

    def _note_raised(self, links: list[Link]) -> None:
        """Add a note with the moving links that got a minimal inertia."""
        names = [f"'{link.name}'" for link in links]
        if len(links) == 1:
            mass, _, moments = self.stated[links[0].name]
            found = f"moving link {names[0]} has no inertia "
            found += f"({mass:g} kg, {principal_text(moments)} kg*m^2)"
        else:
            more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
            found = f"{len(links)} moving links have no inertia "
            found += f"({', '.join(names[:_MAX_NAMED])}{more})"
        self.note(
            links[0].inertial or links[0].node,
            f"{found}: raised to {inertia.MASS_FLOOR:g} kg and kg*m^2 so that the model can be "
            "simulated; simulated motions are not meaningful until their masses are stated",
        )

    def _stated(self, link: Link) -> tuple[float, Vector, Vector]:
        """Mass, centre of mass and inertia of a link, with the fit applied."""
        mass, com, moments = link.mass, link.com, link.inertia
        patched = self.inertia_patches.get(link.name, {})
        if "mass" in patched:
            mass = float(patched["mass"])  # type: ignore[arg-type]
        if "com" in patched:
            com = np.array(patched["com"], dtype=np.float64)
        if "inertia" in patched:
            moments = inertia.tensor(patched["inertia"])  # type: ignore[arg-type]
        return mass, com, self._consistent_inertia(link, moments)

    def _consistent_inertia(self, link: Link, moments: Vector) -> Vector:
        if np.abs(moments).max() < inertia.MASS_FLOOR:
            # Zero apart from rounding errors of the frame transformation.
            return np.zeros((3, 3))
        share = inertia.violation(moments)
        if share == 0.0:
            return moments
        node = link.inertial or link.node
        if share > inertia.ROUNDING and not self.accept_invalid_inertia:
            raise node.error(
                f"link '{link.name}' has an inertia that no body can have: "
                "a principal moment exceeds the sum of the other two, or is negative",
                "inertia",
                value=principal_text(moments),
                unit="kg*m^2",
                expected="a <= b <= c with c <= a + b; state the true one under 'fit: body:'",
            )
        repaired = inertia.nearest_consistent(moments)
        if share > inertia.ROUNDING:
            self.out.inertia_repairs[link.name] = inertia.six_components(repaired)
        why = "rounded digits" if share <= inertia.ROUNDING else "accepted repair"
        self.note(
            node,
            f"inertia of link '{link.name}' breaks the triangle inequality: principal moments "
            f"{principal_text(moments)} became {principal_text(repaired)} kg*m^2 ({why})",
        )
        return repaired

    def _has_inertia(self, link: Link) -> bool:
        """Whether the link, or a link fixed to it, has the inertia that MuJoCo requires."""
        waiting = [link]
        while waiting:
            candidate = waiting.pop()
            mass, _, moments = self.stated[candidate.name]
            if min(mass, np.linalg.eigvalsh(moments).min()) >= inertia.MASS_FLOOR:
                return True
            waiting.extend(
                self.robot.links[joint.child]
                for joint in self.robot.children[candidate.name]
                if joint.type == "fixed"
            )
        return False

    # -- shapes

    def _collisions(self, link: Link) -> None:
        body = self.bodies[link.name]
        for index, node in enumerate(link.node.all("collision")):
            geometry = node.find("geometry")
            shapes = [] if geometry is None else geometry.children
            if len(shapes) != 1:
                raise node.error(
                    f"collision of link '{link.name}' has {len(shapes)} shapes", expected="one"
                )
            position, axes = origin(node)
            details = self._shape(link, shapes[0], position, axes)
            if details is None:
                continue
            name = node.attributes.get("name") or f"{link.name}_collision_{index}"
            if name in self.geom_names:
                name = f"{link.name}_{name}_{index}"
            while name in self.geom_names:
                name += "_"
            self.geom_names.add(name)
            body.add_geom(name=name, group=3, **details)

    def _shape(
        self, link: Link, node: Node, position: Vector, axes: Vector
    ) -> dict[str, Any] | None:
        place = {"pos": position, "quat": _quaternion(axes)}
        kinds = mujoco.mjtGeom
        if node.tag == "box":
            size = node.numbers("size", None, size=3, unit="m") / 2
            details = {"type": kinds.mjGEOM_BOX, "size": size}
        elif node.tag in ("cylinder", "capsule"):
            radius = node.number("radius", None, unit="m")
            size = np.array([radius, node.number("length", None, unit="m") / 2, 0.0])
            cylinder = node.tag == "cylinder"
            details = {
                "type": kinds.mjGEOM_CYLINDER if cylinder else kinds.mjGEOM_CAPSULE,
                "size": size,
            }
        elif node.tag == "sphere":
            size = np.array([node.number("radius", None, unit="m"), 0.0, 0.0])
            details = {"type": kinds.mjGEOM_SPHERE, "size": size}
        elif node.tag == "mesh":
            return self._mesh(link, node, position, axes)
        else:
            raise node.error(
                f"collision of link '{link.name}' has no known shape",
                value=node.tag,
                expected="box, cylinder, capsule, sphere or mesh",
            )
        needed = {"box": 3, "sphere": 1}.get(node.tag, 2)
        if (size[:needed] < 0).any():
            raise node.error(
                f"collision of link '{link.name}' has a negative size",
                value=float(size[:needed].min()),
                unit="m",
                expected="0 m or more",
            )
        if (size[:needed] == 0).any():
            self.note(node, f"collision of link '{link.name}' has no size and is left out")
            return None
        return {**place, **details}

    def _mesh(
        self, link: Link, node: Node, position: Vector, axes: Vector
    ) -> dict[str, Any] | None:
        path = mesh_file(node, self.files)
        scale = node.numbers("scale", (1.0, 1.0, 1.0))
        if (scale == 0).any():
            raise node.error(
                "a mesh without size",
                "scale",
                value=node.attributes["scale"],
                expected="three factors other than 0",
            )
        triangles = self._triangles(node, path).scaled(scale)
        if not np.abs(triangles.vertices).max() < _MAX_EXTENT:
            raise node.error(
                "the mesh is too large", "scale", expected=f"less than {_MAX_EXTENT:g} m"
            )
        if triangles.thickness < _MIN_THICKNESS:
            return self._thin_box(link, node, triangles, position, axes)
        key = (path, tuple(scale.tolist()))
        if key not in self.mesh_names:
            name = path.stem
            while name in self.out.mesh_paths:
                name += "_"
            self.mesh_names[key] = name
            self.out.mesh_paths[name] = path
            made = self.spec.add_mesh(name=name)
            made.uservert = triangles.vertices.ravel()
            made.userface = triangles.faces.ravel()
            # The mesh has no mass, but MuJoCo needs an inertia, and that of a shell is valid
            # for any orientation of the faces.
            made.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            if triangles.up_axis != "Z_UP":
                self.other_axes[triangles.up_axis] += 1
        return {
            "type": mujoco.mjtGeom.mjGEOM_MESH,
            "meshname": self.mesh_names[key],
            "pos": position,
            "quat": _quaternion(axes),
        }

    def _thin_box(
        self, link: Link, node: Node, triangles: mesh.Triangles, position: Vector, axes: Vector
    ) -> dict[str, Any]:
        """A thin box around a mesh without volume."""
        centre = triangles.vertices.mean(axis=0)
        frame = triangles.principal_axes
        local = (triangles.vertices - centre) @ frame
        half = np.maximum(np.ptp(local, axis=0) / 2, _BOX_THICKNESS / 2)
        middle = centre + frame @ ((local.max(axis=0) + local.min(axis=0)) / 2)
        self.note(
            node,
            f"flat collision mesh of link '{link.name}' became a box "
            f"{_BOX_THICKNESS * 1e3:g} mm thick",
        )
        return {
            "type": mujoco.mjtGeom.mjGEOM_BOX,
            "size": half,
            "pos": position + axes @ middle,
            "quat": _quaternion(axes @ frame),
        }

    def _triangles(self, node: Node, path: Path) -> mesh.Triangles:
        if path not in self.triangles:
            try:
                triangles = mesh.read(path)
            except TwinError as error:
                error.problem += f"; used at {node.place}"
                raise
            self.triangles[path] = triangles
            self.out.beside.update(mesh.files_of(path)[1:])
            self.bytes += path.stat().st_size
            self.faces += len(triangles.faces)
            if self.bytes > LIMITS.total_asset_bytes:
                raise node.limit(
                    "the meshes are too large", expected=f"{LIMITS.total_asset_bytes} bytes"
                )
            if self.faces > LIMITS.total_mesh_faces:
                raise node.limit(
                    "the meshes have too many triangles",
                    expected=f"at most {LIMITS.total_mesh_faces}",
                )
        return self.triangles[path]

    # -- the rest

    def _exclude_base(self) -> None:
        """Exclude collisions of the two links of a joint whose parent is fixed to the world.

        MuJoCo excludes the other pairs of parent and child itself.
        """
        still = [self.robot.root]
        for joint in self.robot.in_order():
            if joint.type == "fixed" and joint.parent in still:
                still.append(joint.child)
        for joint in self.robot.in_order():
            if joint.type == "fixed" or joint.parent not in still:
                continue
            moving = [joint.child]
            for other in self.robot.in_order():
                if other.type == "fixed" and other.parent in moving:
                    moving.append(other.child)
            for first in still:
                for second in moving:
                    if self.bodies[first].geoms and self.bodies[second].geoms:
                        self.spec.add_exclude(
                            name=f"{first}_{second}",
                            bodyname1=self.bodies[first].name,
                            bodyname2=second,
                        )

    def _note_left_out(self) -> None:
        for axis, count in self.other_axes.items():
            self.note(
                self.robot.node,
                f"{count} COLLADA or glTF meshes state {axis}; their vertices are not rotated",
            )
        counts = Counter[str]()
        for node in self.robot.node.walk():
            if node.tag in ("visual", "gazebo", "transmission", "sensor", "ros2_control"):
                counts[node.tag] += 1
            if node.tag in ("safety_controller", "calibration"):
                counts[node.tag] += 1
        if counts:
            listed = ", ".join(f"{count} {tag}" for tag, count in sorted(counts.items()))
            self.note(self.robot.node, f"left out: {listed}")


def mesh_file(node: Node, files: UrdfFiles) -> Path:
    """Path of the file of a ``mesh`` element.

    Raises:
        ModelError: the element names no file.
        PathError: its package is not found, or the file does not exist or is outside the roots.
    """
    reference = node.attributes.get("filename", "")
    if not reference:
        raise node.error("no file", "filename", expected="the path of a mesh")
    return files.find(reference, at=node.path, line=node.line, where="mesh.filename")


def _quaternion(axes: Vector) -> Vector:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(axes).ravel())
    return quaternion
