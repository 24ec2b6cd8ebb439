"""Read an MJCF for the audit: the compiled model, or the XML text if it does not compile."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.audit import simulation
from pytest_twin.audit.asset import (
    Actuator,
    Asset,
    Body,
    Coupling,
    Edge,
    Joint,
    JointKind,
    Mimic,
    Sensor,
    Shape,
    Vector,
)
from pytest_twin.audit.finding import LAYERS, Place, finding_of, from_error
from pytest_twin.errors import ModelError, TwinError
from pytest_twin.realization import inertia, mjcf
from pytest_twin.realization.equality_rows import EqualityRows
from pytest_twin.realization.files.locate import ModelFolders
from pytest_twin.realization.inputs import joint_inputs
from pytest_twin.realization.mesh import Triangles
from pytest_twin.realization.node import Node

_KINDS: Mapping[int, JointKind] = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
}
_MEANS = {
    "position": "position setpoint",
    "velocity": "velocity setpoint",
    "effort": "torque or force",
}
_LINE = re.compile(r"line (\d+)")
_MOST_KEYFRAMES = 20
_RADIANS_READ_AS_DEGREES = math.radians(2 * math.pi)
"""rad: a full turn in radians, interpreted as degrees."""


def read(path: Path, located: ModelFolders) -> Asset:
    """Read an MJCF file and everything that it refers to.

    Raises:
        FormatError: not well-formed, or a limit is exceeded.
        PathError: a reference leaves the roots or does not exist.
        ModelError: MuJoCo's parser refuses it for another reason than a duplicate name.
    """
    try:
        document = mjcf.read(path, located.roots)
    except TwinError:
        root = mjcf.read_tree(path, located.roots)
        nodes = _Nodes(root)
        if not nodes.twice:
            raise
        return _of_text(path, root, nodes)
    nodes = _Nodes(document.root)
    try:
        spec = mjcf.build(document)
    except ModelError:
        if not nodes.twice:
            raise
        return _of_text(path, document.root, nodes)
    out = _named_asset(path, document.root, nodes)
    out.located = located
    out.files = sorted({*out.files, *document.asset_paths.values()})
    try:
        model, warned = mjcf.compile_spec(spec)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        refusal = mjcf.translate(error, path, document.places)
        layer = next((word for word in ("inertia", "mesh") if word in refusal.problem), "tree")
        out.faults.append(
            from_error(
                refusal,
                {"mesh": "meshes.refused"}.get(layer, f"{layer}.refused"),
                f"robot '{out.name}'",
                why="no simulator can step it",
            )
        )
        _bodies_of_spec(spec, nodes, out)
        audited = ("tree", "inertia")
        out.unseen = {
            layer: "the model does not compile" for layer in LAYERS if layer not in audited
        }
        return out
    for words in warned:
        out.faults.append(
            finding_of(
                "tree.compiler_warning",
                out.place,
                f"robot '{out.name}'",
                title=f"MuJoCo warns: {words}",
            )
        )
    _Compiled(spec, model, nodes, document, out).read()
    return out


def _named_asset(path: Path, root: Node, nodes: _Nodes) -> Asset:
    out = Asset("mjcf", path, root.attributes.get("model", path.stem), root)
    out.named = nodes.named
    out.files = sorted({node.path for node in root.walk()})
    return out


def _of_text(path: Path, root: Node, nodes: _Nodes) -> Asset:
    """Read only the tree of a model that MuJoCo refuses because of a duplicate name."""
    out = _named_asset(path, root, nodes)
    _bodies_of_text(root, out)
    out.unseen = dict.fromkeys(LAYERS[1:], "MuJoCo refuses a model with two elements of one name")
    return out


class _Nodes:
    """Lines of elements in the text, by kind and name."""

    def __init__(self, root: Node) -> None:
        self.root = Place(root.path, root.line)
        self.by_name: dict[tuple[str, str], Node] = {}
        self.named: list[tuple[str, str, Place]] = []
        self.twice = False
        self.inertials: dict[tuple[Path, int | None], Place] = {
            (node.path, node.line): Place(found.path, found.line)
            for node in root.walk()
            if node.tag == "body" and (found := node.find("inertial")) is not None
        }
        for section in root.children:
            if section.tag == "default":
                continue
            for node in section.children if section.tag == "asset" else section.walk():
                kind = self._kind(section.tag, node.tag)
                name = node.attributes.get("name")
                if section.tag == "asset":
                    name = mjcf.asset_name(node)
                if kind is None or not name:
                    continue
                self.twice |= (kind, name) in self.by_name
                self.by_name.setdefault((kind, name), node)
                self.named.append((kind, name, Place(node.path, node.line)))

    @staticmethod
    def _kind(section: str, tag: str) -> str | None:
        if section == "worldbody":
            return {"freejoint": "joint"}.get(
                tag, tag if tag in ("body", "joint", "geom", "site") else None
            )
        if section == "asset":
            return tag
        return section if section in ("actuator", "sensor", "equality", "tendon") else None

    def place(self, kind: str, name: str) -> Place:
        node = self.by_name.get((kind, name))
        return self.root if node is None else Place(node.path, node.line)

    def inertial(self, body: str, place: Place | None = None) -> Place:
        """File and line of a body's mass and inertia, or else of the body.

        Args:
            place: its place, where it is known.
        """
        body_place = place or self.place("body", body)
        return self.inertials.get((body_place.path, body_place.line), body_place)


def _bodies_of_text(root: Node, out: Asset) -> None:
    """Read bodies and edges from the XML text."""
    out.bodies.append(Body("world", out.place, stated=False))
    world = root.find("worldbody")
    waiting = [("world", node) for node in (world.all("body") if world else [])]
    while waiting:
        parent, node = waiting.pop(0)
        name = node.attributes.get("name") or f"body in line {node.line}"
        place = Place(node.path, node.line)
        out.bodies.append(Body(name, place, stated=False))
        out.edges.append(Edge(name, place, parent, name, np.zeros(3), np.eye(3)))
        waiting += [(name, child) for child in node.all("body")]


def _bodies_of_spec(spec: mujoco.MjSpec, nodes: _Nodes, out: Asset) -> None:
    """Read stated mass and inertia of a model that does not compile."""
    for body in spec.bodies:
        name = body.name or f"body {body.id}"
        place = nodes.place("body", name)
        found = Body(name, place, stated=False, inertial=nodes.inertial(name))
        if body.explicitinertial:
            found.stated = True
            found.mass = float(body.mass)
            found.com = np.array(body.ipos, dtype=np.float64)
            full = np.array(body.fullinertia, dtype=np.float64)
            diagonal = np.array(body.inertia, dtype=np.float64)
            found.inertia = inertia.tensor(full) if np.isfinite(full[0]) else np.diag(diagonal)
        out.bodies.append(found)
        # MuJoCo 3.11 ends the process when the parent of the world is read.
        if name != "world":
            parent = body.parent
            out.edges.append(
                Edge(
                    name,
                    place,
                    parent.name or f"body {parent.id}",
                    name,
                    np.array(body.pos, dtype=np.float64),
                    np.eye(3),
                )
            )


class _Compiled:
    def __init__(
        self,
        spec: mujoco.MjSpec,
        model: mujoco.MjModel,
        nodes: _Nodes,
        document: mjcf.Document,
        out: Asset,
    ) -> None:
        self.spec = spec
        self.model = model
        self.nodes = nodes
        self.assets = document.asset_paths
        self.out = out
        self.lines = {} if document.models else _lines_of_elements(spec, document)
        """Kind of element -> id -> file and line. Lines of attached models are those of another
        document, so that only names lead to places there."""
        self.meshes: dict[int, Triangles] = {}

    def name(self, kind: str, index: int) -> str:
        found = mujoco.mj_id2name(
            self.model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), index
        )
        return found or f"{kind} {index}"

    def place(self, kind: str, index: int) -> Place:
        """File and line of an element; those of the whole model where they are unknown."""
        line_place = self.lines.get(kind, {}).get(index)
        return line_place or self.nodes.place(kind, self.name(kind, index))

    def read(self) -> None:
        self._bodies()
        self._joints()
        self._geoms()
        self._equalities()
        self._actuators()
        self._rest()
        self._angles()
        self.out.faults += simulation.check(self.model, self.place, self.name)
        self.out.constrained = _constrained(self.model)

    def _bodies(self) -> None:
        model = self.model
        explicit = {body.id: bool(body.explicitinertial) for body in self.spec.bodies}
        for index in range(model.nbody):
            name = self.name("body", index)
            place = self.place("body", index)
            axes = _matrix(model.body_iquat[index])
            moments = np.diag(model.body_inertia[index])
            self.out.bodies.append(
                Body(
                    name,
                    place,
                    float(model.body_mass[index]),
                    model.body_ipos[index].copy(),
                    axes @ moments @ axes.T,
                    explicit.get(index, False),
                    self.nodes.inertial(name, place),
                )
            )
            if index:
                self.out.edges.append(
                    Edge(
                        name,
                        place,
                        self.name("body", int(model.body_parentid[index])),
                        name,
                        model.body_pos[index].copy(),
                        _matrix(model.body_quat[index]),
                    )
                )
        stated = [body for body in self.spec.bodies if body.explicitinertial]
        if stated and self.spec.compiler.inertiafromgeom == int(
            mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        ):
            self.out.faults.append(
                finding_of(
                    "inertia.replaced",
                    self.out.place,
                    f"robot '{self.out.name}'",
                    title=f"inertiafromgeom replaces the stated inertia of {len(stated)} bodies "
                    "by that of their shapes",
                )
            )
        if self.spec.compiler.balanceinertia:
            self.out.faults.append(
                finding_of("inertia.balanced", self.out.place, f"robot '{self.out.name}'")
            )

    def _joints(self) -> None:
        model = self.model
        for index in range(model.njnt):
            kind = _KINDS[int(model.jnt_type[index])]
            name = self.name("joint", index)
            dof = int(model.jnt_dofadr[index])
            limited = bool(model.jnt_limited[index])
            low, high = (float(value) for value in model.jnt_range[index])
            force = None
            if model.jnt_actfrclimited[index]:
                force = float(np.abs(model.jnt_actfrcrange[index]).max())
            self.out.joints.append(
                Joint(
                    name,
                    self.place("joint", index),
                    kind,
                    self.name("body", int(model.jnt_bodyid[index])),
                    model.jnt_axis[index].copy(),
                    model.jnt_pos[index].copy(),
                    lower=low if limited else None,
                    upper=high if limited else None,
                    is_limited=limited,
                    effort=force,
                    damping=float(np.abs(model.dof_damping[dof]).max()),
                    friction=float(model.dof_frictionloss[dof]),
                    reference=float(model.qpos0[model.jnt_qposadr[index]])
                    if kind in ("hinge", "slide")
                    else 0.0,
                )
            )

    def _geoms(self) -> None:
        model = self.model
        paired = {int(g) for g in (*model.pair_geom1, *model.pair_geom2)}
        kinds = mujoco.mjtGeom
        plain: dict[int, tuple[str, Callable[[Vector], Iterable[float]]]] = {
            int(kinds.mjGEOM_SPHERE): ("sphere", lambda s: (s[0],)),
            int(kinds.mjGEOM_CAPSULE): ("capsule", lambda s: (s[0], 2 * s[1])),
            int(kinds.mjGEOM_CYLINDER): ("cylinder", lambda s: (s[0], 2 * s[1])),
            int(kinds.mjGEOM_ELLIPSOID): ("ellipsoid", lambda s: s),
            int(kinds.mjGEOM_BOX): ("box", lambda s: 2 * s),
        }
        for index in range(model.ngeom):
            collides = (
                bool(model.geom_contype[index])
                or bool(model.geom_conaffinity[index])
                or index in paired
            )
            kind, size = plain.get(int(model.geom_type[index]), ("other", lambda _: ()))
            shape = Shape(
                self.place("geom", index),
                self.name("body", int(model.geom_bodyid[index])),
                "collision" if collides else "visual",
                kind,
                model.geom_pos[index].copy(),
                _matrix(model.geom_quat[index]),
                tuple(float(value) for value in size(model.geom_size[index])),
                masks=(int(model.geom_contype[index]), int(model.geom_conaffinity[index])),
                is_paired=index in paired,
            )
            if int(model.geom_type[index]) == int(kinds.mjGEOM_MESH):
                self._mesh(shape, int(model.geom_dataid[index]))
            self.out.shapes.append(shape)

    def _mesh(self, shape: Shape, mesh: int) -> None:
        model = self.model
        shape.kind = "mesh"
        if mesh not in self.meshes:
            vertex, face = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
            self.meshes[mesh] = Triangles(
                model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[mesh])].astype(np.float64),
                model.mesh_face[face : face + int(model.mesh_facenum[mesh])].copy(),
            )
        shape.triangles = self.meshes[mesh]
        named = self.spec.mesh(model.mesh(mesh).name)
        if named is not None:
            # A mesh without a file still has a name.
            shape.file = self.assets.get(named.file, Path(named.file or named.name))
            shape.scale = np.array(named.scale, dtype=np.float64)

    def _equalities(self) -> None:
        model = self.model
        kinds = mujoco.mjtEq
        for index in range(model.neq):
            name = self.name("equality", index)
            place = self.place("equality", index)
            kind = int(model.eq_type[index])
            first, second = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
            words = kinds(kind).name.removeprefix("mjEQ_").lower()
            if kind == int(kinds.mjEQ_JOINT) and second >= 0:
                data = model.eq_data[index]
                if not np.any(data[2:5]):
                    self.out.mimics.append(
                        Mimic(
                            place,
                            self.name("joint", first),
                            self.name("joint", second),
                            float(data[1]),
                            float(data[0]),
                            bool(model.eq_active0[index]),
                        )
                    )
                    continue
            element = {
                int(kinds.mjEQ_JOINT): "joint",
                int(kinds.mjEQ_TENDON): "tendon",
            }.get(kind, "body")
            if int(model.eq_objtype[index]) == int(mujoco.mjtObj.mjOBJ_SITE):
                element = "site"
            ties = tuple(self.name(element, one) for one in (first, second) if one >= 0)
            self.out.couplings.append(Coupling(place, f"{words} equality", name, ties))
        for index in range(model.ntendon):
            name = self.name("tendon", index)
            start = int(model.tendon_adr[index])
            wraps: list[str] = []
            for wrap in range(start, start + int(model.tendon_num[index])):
                kind = int(model.wrap_type[wrap])
                if kind == int(mujoco.mjtWrap.mjWRAP_JOINT):
                    wraps.append(self.name("joint", int(model.wrap_objid[wrap])))
                elif kind == int(mujoco.mjtWrap.mjWRAP_SITE):
                    wraps.append(self.name("site", int(model.wrap_objid[wrap])))
            self.out.couplings.append(
                Coupling(self.place("tendon", index), "tendon", name, tuple(wraps))
            )

    def _actuators(self) -> None:
        model = self.model
        means: dict[int, list[str]] = {}
        for joint in self.out.joints:
            for item in joint_inputs(model, joint.name):
                means.setdefault(item.actuator, []).append(
                    f"{_MEANS[item.mode]} (1 {joint.unit if item.mode == 'position' else 'unit'} "
                    f"of the joint is {item.scale:.4g} of the command)"
                    if item.scale != 1.0
                    else _MEANS[item.mode]
                )
        transmissions = mujoco.mjtTrn
        for index in range(model.nactuator):
            name = self.name("actuator", index)
            kind = int(model.actuator_trntype[index])
            target = int(model.actuator_trnid[index, 0])
            joints: tuple[str, ...] = ()
            if kind in (
                int(transmissions.mjTRN_JOINT),
                int(transmissions.mjTRN_JOINTINPARENT),
            ):
                joints = (self.name("joint", target),)
            elif kind == int(transmissions.mjTRN_TENDON):
                tendon = self.name("tendon", target)
                joints = next(
                    tuple(t for t in tie.ties if t in self.out.joint)
                    for tie in self.out.couplings
                    if tie.kind == "tendon" and tie.name == tendon
                )
            control = int(model.actuator_ctrladr[index])
            has_control = 0 <= control < model.nu
            limited = has_control and bool(model.actuator_ctrllimited[control])
            output = int(model.actuator_outadr[index])
            bounded = bool(model.actuator_forcelimited[output])
            self.out.actuators.append(
                Actuator(
                    self.place("actuator", index),
                    name,
                    joints,
                    " and ".join(means[index]) if index in means else None,
                    float(model.actuator_ctrlrange[control, 0]) if limited else None,
                    float(model.actuator_ctrlrange[control, 1]) if limited else None,
                    float(np.abs(model.actuator_forcerange[output]).max()) if bounded else None,
                    float(np.linalg.norm(model.actuator_gear[output])),
                )
            )

    def _rest(self) -> None:
        model = self.model
        objects = mujoco.mjtObj
        for index in range(model.nsensor):
            name = self.name("sensor", index)
            carrier = ""
            kind = int(model.sensor_objtype[index])
            if kind >= 0 and int(model.sensor_objid[index]) >= 0:
                words = objects(kind).name.removeprefix("mjOBJ_").lower()
                words = {"xbody": "body"}.get(words, words)
                if words in ("body", "joint", "site", "geom", "actuator", "tendon"):
                    carrier = self.name(words, int(model.sensor_objid[index]))
            self.out.sensors.append(
                Sensor(
                    self.place("sensor", index),
                    name,
                    mujoco.mjtSensor(int(model.sensor_type[index]))
                    .name.removeprefix("mjSENS_")
                    .lower(),
                    carrier,
                )
            )
        for index in range(model.nsite):
            name = self.name("site", index)
            self.out.sites[name] = (
                self.name("body", int(model.site_bodyid[index])),
                model.site_pos[index].copy(),
                self.place("site", index),
            )
        for index in range(model.nkey):
            # Keyframes follow the joint order of the compiled model; not all joints have names.
            pose = {
                joint.name: float(model.key_qpos[index, address])
                for joint, address in zip(self.out.joints, model.jnt_qposadr, strict=True)
                if joint.is_scalar
            }
            self.out.poses[self.name("key", index)] = pose

    def _angles(self) -> None:
        """Report ranges that look like radians in a file whose angles are degrees."""
        limited = [j for j in self.out.joints if j.kind == "hinge" and j.is_limited]
        largest = max((max(abs(j.lower or 0), abs(j.upper or 0)) for j in limited), default=0.0)
        if len(limited) > 1 and self.spec.compiler.degree and largest <= _RADIANS_READ_AS_DEGREES:
            self.out.faults.append(
                finding_of(
                    "joints.range_radians",
                    limited[0].place,
                    f"joint '{limited[0].name}'",
                    largest,
                    title=f"the ranges of all {len(limited)} hinges are tiny: "
                    "radians read as degrees?",
                )
            )


def _lines_of_elements(spec: mujoco.MjSpec, document: mjcf.Document) -> dict[str, dict[int, Place]]:
    """Return kind of element -> id in the compiled model -> file and line."""
    found: dict[str, dict[int, Place]] = {}
    for kind, elements in (
        ("body", spec.bodies),
        ("joint", spec.joints),
        ("geom", spec.geoms),
        ("site", spec.sites),
        ("actuator", spec.actuators),
        ("sensor", spec.sensors),
        ("equality", spec.equalities),
        ("tendon", spec.tendons),
    ):
        places = found.setdefault(kind, {})
        for element in elements:
            line = _LINE.fullmatch(element.info)
            if line is not None and 1 <= int(line[1]) <= len(document.places):
                places[element.id] = Place(*document.places[int(line[1]) - 1])
    return found


def _constrained(model: mujoco.MjModel) -> int:
    """Degrees of freedom that active equality constraints remove, at the reference or a keyframe.

    A singular pose removes fewer than others, so that the largest number counts.
    """
    rows = EqualityRows(model)
    most = 0
    for pose in (model.qpos0, *model.key_qpos[:_MOST_KEYFRAMES]):
        _, jacobian = rows.at(pose)
        if len(jacobian):
            most = max(most, int(np.linalg.matrix_rank(jacobian, tol=1e-6)))
    return most


def _matrix(quaternion: Vector) -> Vector:
    found = np.empty(9)
    mujoco.mju_quat2Mat(found, np.asarray(quaternion, dtype=np.float64))
    return found.reshape(3, 3)
