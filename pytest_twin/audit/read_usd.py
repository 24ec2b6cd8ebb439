"""Read a USD stage for the audit: bodies, joints and shapes of UsdPhysics, in metres."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.audit.asset import (
    Actuator,
    Asset,
    Body,
    Coupling,
    Edge,
    Joint,
    JointKind,
    Mimic,
    Shape,
    Vector,
)
from pytest_twin.audit.finding import Place
from pytest_twin.errors import FormatError, ModelError, require_at_most
from pytest_twin.formats.paths import Roots, read_bytes
from pytest_twin.realization.limits import LIMITS
from pytest_twin.realization.mesh import Triangles
from pytest_twin.realization.usd import import_openusd, missing
from pytest_twin.realization.usd_names import display_name
from pytest_twin.realization.usd_read import rotation

WORLD = "world"
_MOST_LAYERS = 200
"""Largest number of layers of a stage."""
_AXES = {"X": 0, "Y": 1, "Z": 2}
_KINDS: Mapping[str, JointKind] = {
    "PhysicsRevoluteJoint": "hinge",
    "PhysicsPrismaticJoint": "slide",
    "PhysicsSphericalJoint": "ball",
    "PhysicsDistanceJoint": "free",
}
_NAMED = re.compile(r'\s*(?:def|over)\s+(?:\w+\s+)?"([^"]+)"')


def read(path: Path, further: Sequence[Path] = ()) -> Asset:
    """Read a stage and every layer that it is composed of.

    Args:
        path: the stage's root layer.
        further: folders besides the stage's own that may contain layers.

    Raises:
        UsdMissingError: OpenUSD is not installed.
        PathError: a layer is missing or outside the allowed folders.
        LimitError: the layers are too many or too large.
        FormatError: not a USD stage.
        ModelError: the stage has no rigid body.
    """
    try:
        import_openusd()
        from pxr import Tf, Usd
    except ImportError:
        raise missing("USD cannot be read", path=path) from None
    try:
        layers = _layers(path, further)
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        words = " ".join(str(error).split())[:200]
        raise FormatError(f"not a USD stage: {words}", path=path) from None
    if stage is None:
        raise FormatError("not a USD stage", path=path, expected=".usda, .usdc, .usd or .usdz")
    return _Reader(stage, path, layers).asset()


def _layers(path: Path, further: Sequence[Path]) -> list[Path]:
    """Return every file of the stage, after checking that it is inside the allowed folders."""
    from pxr import Sdf

    roots = Roots(path.parent, tuple(further))
    found: list[Path] = []
    waiting = [path]
    total = 0
    while waiting:
        file = waiting.pop()
        if file in found:
            continue
        found.append(file)
        require_at_most(len(found), _MOST_LAYERS, "too many layers", path=path)
        total += len(read_bytes(file, LIMITS.asset_bytes))
        require_at_most(
            total, LIMITS.total_asset_bytes, "the layers are too large", unit="bytes", path=path
        )
        layer = Sdf.Layer.FindOrOpen(str(file))
        if layer is None:
            raise FormatError("not a USD layer", path=file, expected=".usda, .usdc or .usd")
        for reference in sorted(layer.GetCompositionAssetDependencies()):
            if reference:
                waiting.append(roots.resolve(reference, at=file))
    return found


class _Reader:
    def __init__(self, stage: Any, path: Path, layers: list[Path]) -> None:
        from pxr import UsdGeom, UsdPhysics

        self.stage = stage
        self.metre = float(UsdGeom.GetStageMetersPerUnit(stage))
        self.kilogram = float(UsdPhysics.GetStageKilogramsPerUnit(stage))
        if not (math.isfinite(self.metre * self.kilogram) and min(self.metre, self.kilogram) > 0):
            raise ModelError(
                "a stage without units that can be used",
                path=path,
                value=f"{self.metre:g} m, {self.kilogram:g} kg",
                expected="metersPerUnit and kilogramsPerUnit above 0",
            )
        self.cache = UsdGeom.XformCache()
        self.out = Asset("usd", path, path.stem)
        if stage.GetDefaultPrim():
            self.out.name = str(stage.GetDefaultPrim().GetName())
        self.out.files = layers
        self.lines = _lines(path)
        self.bodies: dict[Any, str] = {}
        self.prims: dict[str, Any] = {}
        self.joints: dict[str, Any] = {}
        self.faces = 0

    def asset(self) -> Asset:
        from pxr import Usd, UsdPhysics

        prims = []
        for prim in Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()):
            prims.append(prim)
            require_at_most(len(prims), LIMITS.elements, "too many prims", path=self.out.path)
        for prim in prims:
            if prim.HasAPI(UsdPhysics.RigidBodyAPI):
                self._body(prim)
        if not self.bodies:
            raise ModelError(
                "a stage without a rigid body",
                path=self.out.path,
                expected="prims with PhysicsRigidBodyAPI",
            )
        joints = [prim for prim in prims if prim.IsA(UsdPhysics.Joint)]
        self._tree(joints)
        for prim in prims:
            self._shape(prim)
        return self.out

    def place(self, prim: Any) -> Place:
        return Place(self.out.path, self.lines.get(str(prim.GetName())))

    def _name(self, prim: Any, taken: Mapping[str, Any]) -> str:
        name = display_name(prim)
        return str(prim.GetPath()) if name in taken else name

    # -- bodies

    def _body(self, prim: Any) -> None:
        from pxr import UsdPhysics

        name = self._name(prim, self.prims)
        self.bodies[prim.GetPath()] = name
        self.prims[name] = prim
        place = self.place(prim)
        body = Body(name, place, stated=False, inertial=place)
        if prim.HasAPI(UsdPhysics.MassAPI):
            api = UsdPhysics.MassAPI(prim)
            mass = float(api.GetMassAttr().Get() or 0.0) * self.kilogram
            com = np.array(api.GetCenterOfMassAttr().Get(), dtype=np.float64) * self.metre
            moments = np.array(api.GetDiagonalInertiaAttr().Get(), dtype=np.float64)
            if mass != 0:
                body.mass = mass
            if np.isfinite(com).all():
                body.com = com
            if moments.any():
                axes = rotation(api.GetPrincipalAxesAttr().Get())
                scale = self.kilogram * self.metre**2
                body.inertia = axes @ np.diag(moments * scale) @ axes.T
                # A mass of 0 means that it is computed from the shapes, so it is not stated.
                body.stated = mass != 0
        self.out.bodies.append(body)
        self.out.named.append(("body", name, place))

    def _pose(self, prim: Any) -> tuple[Vector, Vector]:
        matrix: Vector = np.array(self.cache.GetLocalToWorldTransform(prim), dtype=np.float64).T
        axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
        return matrix[:3, 3] * self.metre, axes

    # -- joints

    def _tree(self, joints: list[Any]) -> None:
        """Direct joints away from the base as edges; joints that close a loop become couplings."""
        from pxr import UsdPhysics

        ends = {}
        for prim in joints:
            api = UsdPhysics.Joint(prim)
            sides = []
            for relation in (api.GetBody0Rel(), api.GetBody1Rel()):
                targets = relation.GetTargets()
                sides.append(self._above(targets[0]) if targets else WORLD)
            if sides[0] != sides[1]:
                ends[prim] = (sides[0], sides[1])
        if any(WORLD in pair for pair in ends.values()):
            self.out.bodies.insert(0, Body(WORLD, Place(self.out.path), 0.0, stated=False))
        touching: dict[str, list[Any]] = {}
        for prim, pair in ends.items():
            for side in pair:
                touching.setdefault(side, []).append(prim)
        carried = {pair[1] for pair in ends.values()}
        starts = [body.name for body in self.out.bodies]
        starts.sort(key=lambda name: (name != WORLD, name in carried))
        reached: set[str] = set()
        used: set[Any] = set()
        for start in starts:
            if start in reached:
                continue
            reached.add(start)
            waiting = [start]
            while waiting:
                parent = waiting.pop(0)
                for prim in touching.get(parent, ()):
                    first, second = ends[prim]
                    child = second if first == parent else first
                    if prim in used:
                        continue
                    used.add(prim)
                    if child in reached:
                        self.out.couplings.append(
                            Coupling(
                                self.place(prim), "loop joint", display_name(prim), (first, second)
                            )
                        )
                        continue
                    reached.add(child)
                    waiting.append(child)
                    self._joint(prim, parent, child, flipped=child == first)

    def _above(self, target: Any) -> str:
        """Return the body that contains a path, or the world."""
        prim = self.stage.GetPrimAtPath(target)
        while prim and prim.GetPath() not in self.bodies:
            prim = prim.GetParent()
        return self.bodies[prim.GetPath()] if prim else WORLD

    def _joint(self, prim: Any, parent: str, child: str, *, flipped: bool) -> None:
        from pxr import UsdPhysics

        name = self._name(prim, self.joints)
        self.joints[name] = prim
        place = self.place(prim)
        self.out.named.append(("joint", name, place))
        position, axes = self._pose(self.prims[child])
        if parent != WORLD:
            origin, frame = self._pose(self.prims[parent])
            position, axes = frame.T @ (position - origin), frame.T @ axes
        self.out.edges.append(Edge(name, place, parent, child, position, axes))
        kind = _KINDS.get(str(prim.GetTypeName()))
        if kind is None:
            return
        api = UsdPhysics.Joint(prim)
        side = "0" if flipped else "1"
        anchor = np.array(getattr(api, f"GetLocalPos{side}Attr")().Get(), dtype=np.float64)
        turned = rotation(getattr(api, f"GetLocalRot{side}Attr")().Get())
        axis = np.array([1.0, 0.0, 0.0])
        lower = upper = None
        factor = math.pi / 180.0 if kind == "hinge" else self.metre
        if kind in ("hinge", "slide"):
            typed = getattr(UsdPhysics, str(prim.GetTypeName()).removeprefix("Physics"))(prim)
            axis = turned[:, _AXES.get(str(typed.GetAxisAttr().Get()), 0)]
            low, high = typed.GetLowerLimitAttr().Get(), typed.GetUpperLimitAttr().Get()
            if math.isfinite(low) and math.isfinite(high):
                lower, upper = float(low) * factor, float(high) * factor
        joint = Joint(
            name,
            place,
            kind,
            child,
            -axis if flipped else axis,
            anchor * self.metre,
            lower=lower,
            upper=upper,
            is_limited=lower is not None,
            is_continuous=lower is None,
        )
        self.out.joints.append(joint)
        if kind in ("hinge", "slide"):
            self._drive(prim, joint)
            self._mimic(prim, joint, factor)

    def _drive(self, prim: Any, joint: Joint) -> None:
        from pxr import UsdPhysics

        drive = UsdPhysics.DriveAPI(prim, "angular" if joint.kind == "hinge" else "linear")
        if not drive:
            return
        stiffness, damping = drive.GetStiffnessAttr().Get(), drive.GetDampingAttr().Get()
        force = drive.GetMaxForceAttr().Get()
        # Force is kg*m/s^2, torque kg*m^2/s^2, in the stage's units.
        unit = self.kilogram * self.metre ** (2 if joint.kind == "hinge" else 1)
        means = None
        if stiffness:
            means = "position setpoint"
        elif damping:
            means = "velocity setpoint"
        bounded = force is not None and math.isfinite(force)
        joint.effort = float(force) * unit if bounded else None
        self.out.actuators.append(
            Actuator(
                joint.place,
                f"drive of {joint.name}",
                (joint.name,),
                means,
                force=joint.effort,
            )
        )

    def _mimic(self, prim: Any, joint: Joint, factor: float) -> None:
        relation = prim.GetRelationship("newton:mimicJoint")
        if not relation or not relation.GetTargets():
            return
        leader = self.stage.GetPrimAtPath(relation.GetTargets()[0])
        numbers = []
        for name, default in (("newton:mimicCoef1", 1.0), ("newton:mimicCoef0", 0.0)):
            attribute = prim.GetAttribute(name)
            value = attribute.Get() if attribute else None
            numbers.append(default if value is None else float(value))
        self.out.mimics.append(
            Mimic(
                joint.place,
                joint.name,
                display_name(leader) if leader else str(relation.GetTargets()[0]),
                numbers[0],
                numbers[1] * factor,
            )
        )

    # -- shapes

    def _shape(self, prim: Any) -> None:
        from pxr import UsdGeom, UsdPhysics

        if not prim.IsA(UsdGeom.Gprim):
            return
        owner = self._above(prim.GetPath())
        if owner == WORLD:
            return
        origin, frame = self._pose(self.prims[owner])
        matrix: Vector = np.array(self.cache.GetLocalToWorldTransform(prim), dtype=np.float64).T
        scale = np.linalg.norm(matrix[:3, :3], axis=0)
        axes = matrix[:3, :3] / np.where(scale > 0, scale, 1.0)
        shape = Shape(
            self.place(prim),
            owner,
            "collision" if prim.HasAPI(UsdPhysics.CollisionAPI) else "visual",
            "other",
            frame.T @ (matrix[:3, 3] * self.metre - origin),
            frame.T @ axes,
        )
        self._fill(shape, prim, scale * self.metre)
        self.out.shapes.append(shape)

    def _fill(self, shape: Shape, prim: Any, scale: Vector) -> None:
        from pxr import UsdGeom

        kind = str(prim.GetTypeName())
        if kind == "Cube":
            side = float(UsdGeom.Cube(prim).GetSizeAttr().Get())
            shape.kind, shape.size = "box", tuple(float(s) * side for s in scale)
        elif kind == "Sphere":
            radius = float(UsdGeom.Sphere(prim).GetRadiusAttr().Get())
            shape.kind, shape.size = "ellipsoid", tuple(float(s) * radius for s in scale)
        elif kind in ("Cylinder", "Capsule"):
            typed = getattr(UsdGeom, kind)(prim)
            along = _AXES.get(str(typed.GetAxisAttr().Get()), 2)
            # Asset shapes of revolution have their axis along z.
            shape.rotation = shape.rotation @ np.roll(np.eye(3), along - 2, axis=0)
            shape.kind = kind.lower()
            shape.size = (
                float(typed.GetRadiusAttr().Get()) * float(scale[along - 1]),
                float(typed.GetHeightAttr().Get()) * float(scale[along]),
            )
        elif kind == "Mesh":
            shape.kind = "mesh"
            shape.triangles = self._triangles(prim, scale)
            shape.file = Path(f"{self.out.path}#{prim.GetPath()}")

    def _triangles(self, prim: Any, scale: Vector) -> Triangles | None:
        from pxr import UsdGeom

        mesh = UsdGeom.Mesh(prim)
        points = mesh.GetPointsAttr().Get()
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [], dtype=np.int64)
        corners = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], dtype=np.int64)
        if points is None or not len(counts) or counts.min() < 0:
            return None
        vertices = np.array(points, dtype=np.float64).reshape(-1, 3)
        faces = fan(counts, corners)
        self.faces += len(faces)
        require_at_most(
            self.faces,
            LIMITS.total_mesh_faces,
            "the meshes have too many triangles",
            path=self.out.path,
        )
        broken = (
            not len(faces)
            or not np.isfinite(vertices).all()
            or faces.min() < 0
            or faces.max() >= len(vertices)
        )
        return None if broken else Triangles(vertices * scale, faces.astype(np.int32))


def fan(counts: NDArray[np.int64], corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Split polygons into (m, 3) triangles from their first corner; empty if counts disagree."""
    if int(counts.sum()) != len(corners):
        return np.zeros((0, 3), dtype=np.int64)
    starts = np.cumsum(counts) - counts
    pieces = np.maximum(counts - 2, 0)
    first = np.repeat(starts, pieces)
    step = np.arange(int(pieces.sum())) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1)


def _lines(path: Path) -> dict[str, int]:
    """Return prim -> line of its first definition, for a text layer."""
    data = path.read_bytes()
    if not data.startswith(b"#usda"):
        return {}
    found: dict[str, int] = {}
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), start=1):
        match = _NAMED.match(line)
        if match is not None:
            found.setdefault(match[1], number)
    return found
