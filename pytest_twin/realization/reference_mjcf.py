"""Build a Pinocchio model from the values of an MJCF, without MuJoCo's compiler."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from pytest_twin.errors import FormatError, ModelError
from pytest_twin.realization import inertia, mesh, shapes
from pytest_twin.realization.engine import frame_scale
from pytest_twin.realization.named_model import NamedModel
from pytest_twin.realization.rigid_model import RigidModel, add_inertia, moments

Vector = NDArray[np.float64]
Inertia = tuple[float, Vector, Vector]
"""Mass [kg], (3,) centre of mass [m], (3, 3) inertia about it [kg*m^2]."""
_NOTHING: Inertia = (0.0, np.zeros(3), np.zeros((3, 3)))
"""Inertia of a massless body."""
_Alt = mujoco.mjtOrientation
_FromGeom = mujoco.mjtInertiaFromGeom


def build(realization: NamedModel) -> RigidModel:
    """Build the Pinocchio model of a realization's spec.

    Raises:
        ModelError: scaled frames or aligned free joints, which are not supported.
    """
    return _Builder(realization).run()


class _Builder:
    def __init__(self, realization: NamedModel) -> None:
        self.realization = realization
        self.spec = realization.spec
        self.out = RigidModel()
        self.sites: dict[str, tuple[int, pin.SE3]] = {}
        self.ids: dict[str, int] = {}
        self.masses: list[tuple[int, Vector]] = []

    def run(self) -> RigidModel:
        model = self.out.model
        model.gravity.linear = np.array(self.spec.option.gravity)
        self._body(self.spec.worldbody, 0, pin.SE3.Identity())
        self.out.frames.update(self.sites)
        self.out.joints = dict(sorted(self.out.joints.items(), key=lambda item: self.ids[item[0]]))
        total = sum(float(parameters[0]) for _, parameters in self.masses)
        wanted = float(self.spec.compiler.settotalmass)
        scale = wanted / total if wanted > 0 and total > 0 else 1.0
        for joint, parameters in self.masses:
            add_inertia(model, joint, (scale, parameters))
        return self.out

    def _body(self, body: mujoco.MjsBody, parent: int, parent_frame: pin.SE3) -> None:
        joint, frame = parent, parent_frame
        if body.name != "world":
            frame = parent_frame * self._placement(body)
            for joint_spec in body.joints:
                joint, frame = self._joint(joint_spec, joint, frame)
            self.masses.append((joint, moments(*self._inertia(body), frame)))
        if body.name:
            self.out.frames[body.name] = (joint, frame)
        for site in body.sites:
            if site.name:
                self.sites[site.name] = (joint, frame * self._placement(site))
        for child in body.bodies:
            self._body(child, joint, frame)

    def _joint(self, spec: mujoco.MjsJoint, parent: int, frame: pin.SE3) -> tuple[int, pin.SE3]:
        """Add a joint; its index, and the pose of the body in the joint's frame."""
        kinds = mujoco.mjtJoint
        model = self.out.model
        name = spec.name or f"joint#{spec.id}"
        self.ids[name] = spec.id
        self.out.armature[name] = float(spec.armature)
        if spec.type == kinds.mjJNT_FREE:
            self._refuse_alignment(spec)
            joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), name)
            turn = pin.Quaternion(frame.rotation)
            self.out.neutral[name] = np.array([*frame.translation, turn.w, turn.x, turn.y, turn.z])
            self.out.joints[name] = joint
            return joint, pin.SE3.Identity()
        anchor = pin.SE3(np.eye(3), np.array(spec.pos))
        axis = np.array(spec.axis) / np.linalg.norm(spec.axis)
        if spec.type == kinds.mjJNT_HINGE:
            kind: Any = pin.JointModelRevoluteUnaligned(axis)
        elif spec.type == kinds.mjJNT_SLIDE:
            kind = pin.JointModelPrismaticUnaligned(axis)
        else:
            kind = pin.JointModelSpherical()
            self.out.neutral[name] = np.array([1.0, 0.0, 0.0, 0.0])
        if spec.type in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
            degrees = spec.type == kinds.mjJNT_HINGE and spec.compiler.degree
            self.out.reference[name] = math.radians(spec.ref) if degrees else float(spec.ref)
            self.out.neutral[name] = self.out.reference[name]
        joint = model.addJoint(parent, kind, frame * anchor, name)
        self.out.joints[name] = joint
        return joint, anchor.inverse()

    def _refuse_alignment(self, spec: mujoco.MjsJoint) -> None:
        align = mujoco.mjtAlignFree
        if spec.align == align.mjALIGNFREE_TRUE or (
            spec.align == align.mjALIGNFREE_AUTO and spec.compiler.alignfree
        ):
            raise ModelError(
                "no independent reference where a free joint's body is aligned with its inertia",
                path=self.realization.path,
                where=f"joint '{spec.name}'",
                expected='align="false" at the free joint',
            )

    # -- placements

    def _placement(self, element: Any) -> pin.SE3:
        """Pose of a body, site or geom in its parent body, through enclosing ``frame`` elements."""
        placement = self._own_placement(element)
        frame = element.frame
        while frame is not None:
            scale = frame_scale(frame)
            if not np.array_equal(scale, np.ones(3)):
                raise ModelError(
                    "no independent reference for scaled frames",
                    path=self.realization.path,
                    where=f"frame '{frame.name}'",
                    value=scale,
                    expected="scale 1 1 1; scale the meshes instead",
                )
            placement = self._own_placement(frame) * placement
            frame = frame.frame
        return placement

    def _own_placement(self, element: Any) -> pin.SE3:
        ends = getattr(element, "fromto", None)
        if ends is not None and not math.isnan(ends[0]):
            start, end = np.array(ends[:3]), np.array(ends[3:])
            return pin.SE3(_rotation_of_z_to(start - end), (start + end) / 2)
        return pin.SE3(_rotation(element, element.quat, element.alt), np.array(element.pos))

    # -- inertia

    def _inertia(self, body: mujoco.MjsBody) -> Inertia:
        """Mass, centre of mass and inertia of a body in its frame."""
        compiler = body.compiler
        shape = compiler.inertiafromgeom == _FromGeom.mjINERTIAFROMGEOM_TRUE or (
            compiler.inertiafromgeom == _FromGeom.mjINERTIAFROMGEOM_AUTO
            and not body.explicitinertial
        )
        if shape:
            found = self._from_geoms(body)
        elif body.explicitinertial:
            found = _stated_inertia(body)
        else:
            found = _NOTHING
        bounded = compiler.boundmass > found[0] or compiler.boundinertia > 0
        if bounded or (compiler.balanceinertia and inertia.violation(found[2]) > 0):
            return self._from_compiled(body, "the compiler bounds or balances it")
        return found

    def _from_geoms(self, body: mujoco.MjsBody) -> Inertia:
        low, high = body.compiler.inertiagrouprange
        chosen = [geom for geom in body.geoms if low <= geom.group <= high]
        if not chosen and body.explicitinertial:
            return _stated_inertia(body)
        parts: list[Inertia] = []
        for geom in chosen:
            found = self._geom(geom)
            if found is None:
                return self._from_compiled(body, f"geom '{geom.name}' has an unsupported shape")
            mass, com, tensor = found
            placement = self._placement(geom)
            axes = placement.rotation
            parts.append((mass, placement.act(com), axes @ tensor @ axes.T))
        total = sum(mass for mass, _, _ in parts)
        if total == 0:
            return _NOTHING
        com = sum((mass * com for mass, com, _ in parts), np.zeros(3)) / total
        tensor = sum(
            (tensor + inertia.point_inertia(mass, at - com) for mass, at, tensor in parts),
            np.zeros((3, 3)),
        )
        return total, com, tensor

    def _geom(self, geom: mujoco.MjsGeom) -> Inertia | None:
        """Mass, com and inertia of a geom in its frame; None for an unsupported shape."""
        kinds = mujoco.mjtGeom
        if geom.mass == 0 or (math.isnan(geom.mass) and geom.density == 0):
            return _NOTHING
        if geom.type in (kinds.mjGEOM_PLANE, kinds.mjGEOM_HFIELD):
            return _NOTHING
        if geom.typeinertia != mujoco.mjtGeomInertia.mjINERTIA_VOLUME:
            return None
        if geom.type == kinds.mjGEOM_MESH:
            return self._mesh(geom)
        if geom.meshname:
            return None
        size = np.array(geom.size, dtype=np.float64)
        if not math.isnan(geom.fromto[0]):
            length = float(np.linalg.norm(np.array(geom.fromto[:3]) - geom.fromto[3:]))
            if geom.type in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
                size[1] = length / 2
            else:
                size[1], size[2] = size[0], length / 2
        solid = shapes.solid(geom, size)
        if solid is None:
            return None
        volume, per_mass = solid
        mass = volume * geom.density if math.isnan(geom.mass) else float(geom.mass)
        return mass, np.zeros(3), mass * np.diag(per_mass)

    def _mesh(self, geom: mujoco.MjsGeom) -> Inertia | None:
        found = self.spec.mesh(geom.meshname)
        if found is None:
            return None
        modes = mujoco.mjtMeshInertia
        if found.inertia not in (modes.mjMESH_INERTIA_CONVEX, modes.mjMESH_INERTIA_EXACT):
            return None
        if len(found.uservert):
            vertices = np.array(found.uservert, dtype=np.float64).reshape(-1, 3)
            faces = np.array(found.userface, dtype=np.int32).reshape(-1, 3)
        else:
            path = self.realization.source.assets.get(found.file)
            if path is None or path.suffix.lower() not in mesh.SUFFIXES:
                return None
            try:
                triangles = mesh.read(path)
            except FormatError:
                # MuJoCo can read this variant of the format, and our reader cannot.
                return None
            vertices, faces = triangles.vertices, triangles.faces
        vertices = vertices * np.array(found.scale)
        turn = pin.Quaternion(*np.array(found.refquat)).normalized().matrix()
        vertices = (vertices - np.array(found.refpos)) @ turn
        if found.inertia == modes.mjMESH_INERTIA_CONVEX or not len(faces):
            hull = shapes.hull(vertices)
            if hull is None:
                return None
            faces = hull
        whole = shapes.polyhedron(vertices, faces)
        if whole is None:
            return None
        volume, centroid, per_mass = whole
        mass = volume * geom.density if math.isnan(geom.mass) else float(geom.mass)
        return mass, centroid, mass * per_mass

    def _from_compiled(self, body: mujoco.MjsBody, why: str) -> Inertia:
        model = self.realization.model
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.name)
        if index < 0:
            raise ModelError(
                f"no independent reference for a body without a name: {why}",
                path=self.realization.path,
                expected="a name for each body",
            )
        self.out.notes.append(f"inertia of body '{body.name}' is MuJoCo's own: {why}")
        axes = pin.Quaternion(*model.body_iquat[index]).matrix()
        tensor = axes @ np.diag(model.body_inertia[index]) @ axes.T
        return float(model.body_mass[index]), model.body_ipos[index].copy(), tensor


def _stated_inertia(body: mujoco.MjsBody) -> Inertia:
    if not math.isnan(body.fullinertia[0]):
        tensor = inertia.tensor(np.array(body.fullinertia))
    else:
        tensor = np.diag(np.array(body.inertia, dtype=np.float64))
    axes = _rotation(body, body.iquat, body.ialt)
    return float(body.mass), np.array(body.ipos), axes @ tensor @ axes.T


def _rotation(element: Any, quaternion: Vector, alt: mujoco.MjsOrientation) -> Vector:
    """(3, 3) rotation matrix of an orientation in any of MJCF's five representations."""
    unit = math.pi / 180 if element.compiler.degree else 1.0
    if alt.type == _Alt.mjORIENTATION_AXISANGLE:
        x, y, z, angle = (float(v) for v in alt.axisangle)
        axis = np.array([x, y, z]) / math.hypot(x, y, z)
        return np.asarray(pin.exp3(axis * angle * unit))
    if alt.type == _Alt.mjORIENTATION_XYAXES:
        x_axis, y_axis = np.array(alt.xyaxes[:3]), np.array(alt.xyaxes[3:])
        x_axis = x_axis / np.linalg.norm(x_axis)
        y_axis = y_axis - (x_axis @ y_axis) * x_axis
        y_axis = y_axis / np.linalg.norm(y_axis)
        return np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    if alt.type == _Alt.mjORIENTATION_ZAXIS:
        return _rotation_of_z_to(np.array(alt.zaxis))
    if alt.type == _Alt.mjORIENTATION_EULER:
        total = np.eye(3)
        order = "".join(str(letter) for letter in element.compiler.eulerseq)
        for letter, angle in zip(order, alt.euler, strict=True):
            turn = np.asarray(pin.exp3(np.eye(3)["xyz".index(letter.lower())] * angle * unit))
            # Lower case: rotation about axes that moved with the previous rotations (intrinsic).
            total = total @ turn if letter.islower() else turn @ total
        return total
    return np.asarray(pin.Quaternion(*np.array(quaternion)).normalized().matrix())


def _rotation_of_z_to(direction: Vector) -> Vector:
    """(3, 3) smallest rotation that turns the z axis to ``direction`` (3,)."""
    z_axis = direction / np.linalg.norm(direction)
    axis = np.cross([0.0, 0.0, 1.0], z_axis)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-10:
        return np.eye(3) if z_axis[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(pin.exp3(axis / sine * math.atan2(sine, float(z_axis[2]))))
