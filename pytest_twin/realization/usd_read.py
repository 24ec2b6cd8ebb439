"""Read the robot in a USD stage through UsdPhysics, as a physics engine would."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import ModelError
from pytest_twin.metrics.pose import inverse, rigid
from pytest_twin.realization import usd
from pytest_twin.realization.tree import RigidTree, TreeBody, TreeJoint
from pytest_twin.realization.usd_names import display_name, link_prims

Vector = NDArray[np.float64]
_AXES = {"X": 0, "Y": 1, "Z": 2}


@dataclass(frozen=True, slots=True)
class UsdJoint:
    """A joint of the stage.

    Attributes:
        kind: ``revolute``, ``prismatic``, ``fixed``, ``spherical``, ``distance`` or ``d6``.
        body0, body1: links, None for the world.
        limits: (lower, upper), rad or m; None where it is unlimited.
        gap: distance (m) and angle (rad) between its two frames at the initial pose of the stage.
        max_force: limit of its drive, N*m or N; None without a drive.
        stiffness, drive_damping: gains of its drive, N*m/rad and N*m*s/rad, or N/m and N*s/m; 0
            without a drive.
        velocity: limit, rad/s or m/s, or None (not part of UsdPhysics).
        damping: N*m*s/rad or N*s/m, or None (not part of UsdPhysics).
        friction: N*m or N, or None (not part of UsdPhysics).
        has_collision: whether its two bodies collide with each other.
    """

    name: str
    kind: str
    body0: str | None
    body1: str | None
    limits: tuple[float, float] | None
    gap: tuple[float, float]
    max_force: float | None
    stiffness: float
    drive_damping: float
    velocity: float | None
    damping: float | None
    friction: float | None
    has_collision: bool


@dataclass(frozen=True, slots=True)
class UsdShape:
    """A collision shape of the stage.

    Attributes:
        kind: ``box``, ``sphere``, ``cylinder``, ``capsule``, ``mesh``, or ``convex hull`` of one.
        size: full lengths of a box; radius; radius and length, m.
        pose: (4, 4) pose in the link, m.
        points: (n, 3) vertices of a mesh in the frame of ``pose``, m.
    """

    kind: str
    size: Vector
    pose: Vector
    points: Vector


@dataclass(frozen=True, slots=True)
class UsdRobot:
    """A robot in a USD stage.

    Attributes:
        tree: bodies, and joints with one degree of freedom.
        joints: name -> joint, of all types.
        rigid_bodies: links that are rigid bodies.
        mimics: follower -> (leader, multiplier, offset in rad or m), from Newton's schema.
        collisions: link -> its collision shapes.
        disabled_pairs: pairs of links that do not collide.
        materials: number of shapes with a physics material.
        timestep: timestep that the stage states for Newton, s; None without one.
        attributes: names of attributes that belong to no schema, such as ``urdf:limit:effort``.
    """

    tree: RigidTree
    joints: Mapping[str, UsdJoint]
    rigid_bodies: frozenset[str]
    mimics: Mapping[str, tuple[str, float, float]]
    collisions: Mapping[str, tuple[UsdShape, ...]]
    disabled_pairs: frozenset[frozenset[str]]
    materials: int
    timestep: float | None
    attributes: frozenset[str] = field(default_factory=frozenset)


def read(path: Path) -> UsdRobot:
    """Open a stage and read its robot.

    Raises:
        UsdMissingError: the extra ``usd`` is not installed.
        ModelError: not a USD stage, a stage in other units, or a stage without links.
    """
    usd.require()
    from pxr import Tf, Usd, UsdGeom, UsdPhysics

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        words = " ".join(str(error).split())[:200]
        raise ModelError(f"not a USD stage: {words}", path=path) from None
    if not stage.GetDefaultPrim():
        raise ModelError(
            "a stage without a default prim",
            path=path,
            expected="the robot's root prim as defaultPrim; set it in the metadata of the stage",
        )
    metre = UsdGeom.GetStageMetersPerUnit(stage)
    kilogram = UsdPhysics.GetStageKilogramsPerUnit(stage)
    if metre != 1.0 or kilogram != 1.0 or UsdGeom.GetStageUpAxis(stage) != "Z":
        raise ModelError(
            "a stage in other units",
            path=path,
            value=f"{metre:g} m, {kilogram:g} kg, {UsdGeom.GetStageUpAxis(stage)} up",
            expected="1 m, 1 kg, Z up",
        )
    return _Reader(stage, path).robot()


class _Reader:
    def __init__(self, stage: Any, path: Path) -> None:
        from pxr import UsdGeom

        self.stage = stage
        self.path = path
        self.links = link_prims(stage)
        if not self.links:
            raise ModelError(
                "a stage without links",
                path=path,
                expected="Xform prims below the child Geometry of the default prim",
            )
        self.of_prim = {prim.GetPath(): name for name, prim in self.links.items()}
        self.cache = UsdGeom.XformCache()

    def robot(self) -> UsdRobot:
        from pxr import UsdPhysics

        joints: dict[str, UsdJoint] = {}
        moved: dict[str, TreeJoint] = {}
        mimics: dict[str, tuple[str, float, float]] = {}
        disabled: set[frozenset[str]] = set()
        for prim in self.stage.Traverse():
            if not prim.IsA(UsdPhysics.Joint):
                continue
            joint, degree = self._joint(prim)
            joints[joint.name] = joint
            if degree is not None and joint.body1 is not None:
                moved[joint.body1] = degree
            if joint.body0 and joint.body1 and not joint.has_collision:
                disabled.add(frozenset((joint.body0, joint.body1)))
            leader = prim.GetRelationship("newton:mimicJoint")
            if leader and leader.GetTargets():
                mimics[joint.name] = self._mimic(prim, leader.GetTargets()[0])
        disabled |= self._filtered()
        return UsdRobot(
            RigidTree(self._body(name, moved.get(name)) for name in self.links),
            joints,
            frozenset(
                name for name, prim in self.links.items() if prim.HasAPI(UsdPhysics.RigidBodyAPI)
            ),
            mimics,
            self._collisions(),
            frozenset(disabled),
            self._materials(),
            self._timestep(),
            frozenset(
                str(attribute.GetName())
                for prim in self.stage.Traverse()
                for attribute in prim.GetAuthoredAttributes()
                if attribute.IsCustom()
            ),
        )

    # -- bodies

    def _parent_link(self, prim: Any) -> str | None:
        """The nearest link above a prim, None without one."""
        parent = prim.GetParent()
        while parent and parent.GetPath() not in self.of_prim:
            parent = parent.GetParent()
        return self.of_prim[parent.GetPath()] if parent else None

    def _body(self, name: str, joint: TreeJoint | None) -> TreeBody:
        from pxr import UsdPhysics

        prim = self.links[name]
        parent = self._parent_link(prim)
        placement = np.eye(4)
        if parent is not None:
            placement = _placement(prim, self.links[parent])
        mass, com, tensor = 0.0, np.zeros(3), np.zeros((3, 3))
        if prim.HasAPI(UsdPhysics.MassAPI):
            api = UsdPhysics.MassAPI(prim)
            mass = float(api.GetMassAttr().Get() or 0.0)
            com = np.array(api.GetCenterOfMassAttr().Get(), dtype=np.float64)
            com = np.where(np.isfinite(com), com, 0.0)
            axes = rotation(api.GetPrincipalAxesAttr().Get())
            tensor = axes @ np.diag(np.array(api.GetDiagonalInertiaAttr().Get())) @ axes.T
        return TreeBody(name, parent, placement, joint, mass, com, tensor)

    # -- joints

    def _joint(self, prim: Any) -> tuple[UsdJoint, TreeJoint | None]:
        from pxr import UsdPhysics

        api = UsdPhysics.Joint(prim)
        first, second = self._link_of(api.GetBody0Rel()), self._link_of(api.GetBody1Rel())
        frames = (
            _frame(api.GetLocalPos0Attr().Get(), api.GetLocalRot0Attr().Get()),
            _frame(api.GetLocalPos1Attr().Get(), api.GetLocalRot1Attr().Get()),
        )
        name = display_name(prim)
        kind = str(prim.GetTypeName()).removeprefix("Physics").removesuffix("Joint").lower() or "d6"
        limits = None
        degree = None
        if kind in ("revolute", "prismatic"):
            typed = getattr(UsdPhysics, prim.GetTypeName().removeprefix("Physics"))(prim)
            factor = math.pi / 180.0 if kind == "revolute" else 1.0
            lower, upper = typed.GetLowerLimitAttr().Get(), typed.GetUpperLimitAttr().Get()
            if math.isfinite(lower) or math.isfinite(upper):
                limits = (float(lower) * factor, float(upper) * factor)
            axis = np.eye(3)[_AXES[str(typed.GetAxisAttr().Get())]]
            moves = "hinge" if kind == "revolute" else "slide"
            degree = TreeJoint(name, moves, axis, frames[1])  # type: ignore[arg-type]
        turning = kind == "revolute"
        drive = UsdPhysics.DriveAPI(prim, "angular" if turning else "linear")
        force = drive.GetMaxForceAttr().Get() if drive else None
        per_degree = math.pi / 180.0 if turning else 1.0
        velocity, damping = (
            _finite_value(prim, "newton:velocityLimit"),
            _finite_value(prim, "newton:damping"),
        )
        joint = UsdJoint(
            name,
            kind,
            first,
            second,
            limits,
            self._frame_gap(first, second, frames),
            None if force is None else float(force),
            float(drive.GetStiffnessAttr().Get() or 0.0) / per_degree if drive else 0.0,
            float(drive.GetDampingAttr().Get() or 0.0) / per_degree if drive else 0.0,
            None if velocity is None else velocity * per_degree,
            None if damping is None else damping / per_degree,
            _finite_value(prim, "newton:friction"),
            bool(api.GetCollisionEnabledAttr().Get()),
        )
        return joint, degree

    def _timestep(self) -> float | None:
        """1 / ``newton:timeStepsPerSecond`` of the first prim that states it, s."""
        for prim in self.stage.Traverse():
            rate = _finite_value(prim, "newton:timeStepsPerSecond")
            if rate is not None and rate > 0.0:
                return 1.0 / rate
        return None

    def _link_of(self, relation: Any) -> str | None:
        targets = relation.GetTargets()
        return self.of_prim.get(targets[0]) if targets else None

    def _frame_gap(
        self, first: str | None, second: str | None, frames: tuple[Vector, Vector]
    ) -> tuple[float, float]:
        if first is None or second is None:
            return 0.0, 0.0
        poses = [
            _matrix(self.cache.GetLocalToWorldTransform(self.links[name])) @ frame
            for name, frame in zip((first, second), frames, strict=True)
        ]
        apart = inverse(poses[0]) @ poses[1]
        turned = np.linalg.norm(apart[:3, :3] - np.eye(3)) / math.sqrt(2.0)
        return float(np.linalg.norm(apart[:3, 3])), float(turned)

    def _mimic(self, prim: Any, target: Any) -> tuple[str, float, float]:
        factor = math.pi / 180.0 if "Revolute" in str(prim.GetTypeName()) else 1.0
        offset = _finite_value(prim, "newton:mimicCoef0")
        multiplier = _finite_value(prim, "newton:mimicCoef1")
        leader = display_name(self.stage.GetPrimAtPath(target))
        return leader, 1.0 if multiplier is None else multiplier, (offset or 0.0) * factor

    # -- shapes

    def _collisions(self) -> dict[str, tuple[UsdShape, ...]]:
        from pxr import UsdPhysics

        found: dict[str, list[UsdShape]] = {}
        for prim in self.stage.Traverse():
            if prim.HasAPI(UsdPhysics.CollisionAPI):
                owner = self._parent_link(prim)
                if owner is not None:
                    found.setdefault(owner, []).append(self._shape(prim, owner))
        return {name: tuple(held) for name, held in found.items()}

    def _shape(self, prim: Any, owner: str) -> UsdShape:
        from pxr import UsdGeom, UsdPhysics

        relative, _ = self.cache.ComputeRelativeTransform(prim, self.links[owner])
        raw: Vector = np.array(relative, dtype=np.float64).T
        scale = np.linalg.norm(raw[:3, :3], axis=0)
        pose, none = _matrix(relative), np.zeros((0, 3))
        if prim.IsA(UsdGeom.Cube):
            return UsdShape("box", scale * UsdGeom.Cube(prim).GetSizeAttr().Get(), pose, none)
        if prim.IsA(UsdGeom.Sphere):
            radius = UsdGeom.Sphere(prim).GetRadiusAttr().Get()
            return UsdShape("sphere", scale * radius, pose, none)
        for kind in ("Cylinder", "Capsule"):
            if prim.GetTypeName() == kind:
                typed = getattr(UsdGeom, kind)(prim)
                size = scale[[0, 2]] * (typed.GetRadiusAttr().Get(), typed.GetHeightAttr().Get())
                return UsdShape(kind.lower(), size, pose, none)
        stated = UsdGeom.PointBased(prim).GetPointsAttr().Get()
        points = np.array(stated if stated is not None else none, dtype=np.float64)
        # A pose cannot express a reflection, so that the points get the whole linear part.
        pose, points = np.eye(4), points.reshape(-1, 3) @ raw[:3, :3].T
        pose[:3, 3] = raw[:3, 3]
        how = UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get()
        kind = "convex hull" if how == UsdPhysics.Tokens.convexHull else "mesh"
        return UsdShape(kind, np.zeros(3), pose, points)

    def _filtered(self) -> set[frozenset[str]]:
        from pxr import UsdPhysics

        found = set()
        for name, prim in self.links.items():
            if prim.HasAPI(UsdPhysics.FilteredPairsAPI):
                for target in UsdPhysics.FilteredPairsAPI(prim).GetFilteredPairsRel().GetTargets():
                    if target in self.of_prim:
                        found.add(frozenset((name, self.of_prim[target])))
        return found

    def _materials(self) -> int:
        from pxr import UsdPhysics

        return sum(prim.HasAPI(UsdPhysics.MaterialAPI) for prim in self.stage.Traverse())


def _placement(prim: Any, above: Any) -> Vector:
    """(4, 4) pose of a prim in an ancestor, m, without scale.

    The quaternions are converted here, because OpenUSD converts through an angle and loses
    rotations below 2e-8 rad.
    """
    from pxr import UsdGeom

    pose = np.eye(4)
    while prim != above:
        local = np.eye(4)
        for operation in UsdGeom.Xformable(prim).GetOrderedXformOps():
            kind, value = operation.GetOpType(), operation.Get()
            if operation.IsInverseOp():
                step = _matrix(operation.GetOpTransform(0.0))
            elif kind == UsdGeom.XformOp.TypeTranslate:
                step = np.eye(4)
                step[:3, 3] = np.array(value, dtype=np.float64)
            elif kind == UsdGeom.XformOp.TypeOrient:
                step = np.eye(4)
                step[:3, :3] = rotation(value)
            else:
                step = _matrix(operation.GetOpTransform(0.0))
            local = local @ step
        pose = local @ pose
        prim = prim.GetParent()
    return pose


def _finite_value(prim: Any, name: str) -> float | None:
    attribute = prim.GetAttribute(name)
    value = attribute.Get() if attribute else None
    return None if value is None or not math.isfinite(value) else float(value)


def _matrix(value: Any) -> Vector:
    """(4, 4) pose of a Gf matrix (row vectors), without scale."""
    matrix: Vector = np.array(value, dtype=np.float64).T
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    matrix[:3, :3] /= np.where(scale > 0, scale, 1.0)
    return matrix


def rotation(quaternion: Any) -> Vector:
    """(3, 3) rotation matrix of a Gf quaternion; identity for length 0."""
    from scipy.spatial.transform import Rotation

    values = np.array([*quaternion.GetImaginary(), quaternion.GetReal()], dtype=np.float64)
    if not np.isfinite(values).all() or np.linalg.norm(values) < 1e-6:
        return np.eye(3)
    turned: Vector = Rotation.from_quat(values).as_matrix()
    return turned


def _frame(position: Any, quaternion: Any) -> Vector:
    return rigid(rotation(quaternion), np.array(position, dtype=np.float64))
