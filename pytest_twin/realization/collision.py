"""Distances of collision geometries by MuJoCo and by coal, and disabled collision pairs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import combinations, product
from typing import Any

import coal
import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from pytest_twin.errors import ModelError
from pytest_twin.realization import simulate
from pytest_twin.realization.coal_hull import convex_hull, outward_faces
from pytest_twin.realization.collision_filter import (
    are_excluded,
    are_one_or_linked,
    have_matching_masks,
)
from pytest_twin.realization.engine import geom_distance
from pytest_twin.realization.model import Realization

Vector = NDArray[np.float64]
Geom = mujoco.mjtGeom

_GJK_TOLERANCE = 1e-8
"""Tolerance of coal's distances between separate shapes, m."""
# With a smaller tolerance, EPA does not converge for round shapes in deep penetration.
_EPA_TOLERANCE = 1e-6
_ITERATIONS = 1000
"""Largest number of iterations of GJK and EPA."""
_SOME_DISABLED = "contype and conaffinity keep some of their geoms apart"
_SUPPORTED = frozenset(
    {
        Geom.mjGEOM_PLANE,
        Geom.mjGEOM_SPHERE,
        Geom.mjGEOM_CAPSULE,
        Geom.mjGEOM_ELLIPSOID,
        Geom.mjGEOM_CYLINDER,
        Geom.mjGEOM_BOX,
        Geom.mjGEOM_MESH,
    }
)


class Shapes:
    """Geoms of a realization that can collide, by name and body, and their signed distances."""

    def __init__(self, realization: Realization) -> None:
        self._realization = realization
        self._model = realization.model
        self._coal: dict[int, Any] = {}

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Bodies with a geom that can collide; the world may be among them."""
        names = _body_names(self._realization)
        return tuple(names[body] for body in sorted(_bodies(self._model)))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All names that :meth:`geoms` accepts: named geoms, and ``bodies``."""
        return (*self._realization.names("geom"), *self.bodies)

    def geoms(self, name: str) -> frozenset[int]:
        """Index of a named geom, or indices of all geoms of a body that can collide."""
        geom = int(mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_GEOM, name))
        if geom >= 0:
            return frozenset({geom})
        names = _body_names(self._realization)
        body = names.index(name) if name in names else -1
        return frozenset(_bodies(self._model).get(body, ()))

    def distance(self, data: mujoco.MjData, first: frozenset[int], second: frozenset[int]) -> float:
        """Smallest signed distance of two sets of geoms by MuJoCo, m; negative in penetration.

        Args:
            data: state after ``mj_kinematics``.

        Raises:
            ModelError: a height field or signed distance field, for which MuJoCo cannot compute
                the distance to every shape.
        """
        return min(
            geom_distance(self._model, data, (a, b), self._bound(data, a, b))
            for a, b in self._ordered(first, second)
        )

    def distance_by_coal(
        self, data: mujoco.MjData, first: frozenset[int], second: frozenset[int]
    ) -> float:
        """Smallest signed distance by coal, m; NaN where its solver does not converge.

        Primitives are those of coal, and a plane is a half space. A mesh is replaced by the convex
        hull of its vertices, which qhull computes independently of MuJoCo. If the mesh limits the
        number of hull vertices, it is the hull of the vertices that MuJoCo kept.
        """
        least = np.inf
        request = coal.DistanceRequest()
        request.enable_signed_distance = True
        request.gjk_tolerance, request.epa_tolerance = _GJK_TOLERANCE, _EPA_TOLERANCE
        request.gjk_max_iterations = request.epa_max_iterations = _ITERATIONS
        for a, b in self._ordered(first, second):
            kinds = {int(self._model.geom_type[a]), int(self._model.geom_type[b])}
            # For sphere and cylinder, coal's special function ignores penetration through the
            # curved side; with an ellipsoid it uses the general algorithm.
            plain = kinds == {int(Geom.mjGEOM_SPHERE), int(Geom.mjGEOM_CYLINDER)}
            distance = coal.distance(
                self._shape(a, plain),
                self._transform(data, a),
                self._shape(b, plain),
                self._transform(data, b),
                request,
                coal.DistanceResult(),
            )
            if not abs(distance) < 1e9:
                return float("nan")
            least = min(least, distance)
        return float(least)

    def measurable_distance(self, data: mujoco.MjData, first: str, second: str) -> float | None:
        """Smallest distance of two bodies, m; None where MuJoCo or coal cannot compute it."""
        sides = self.geoms(first), self.geoms(second)
        try:
            by_coal = self.distance_by_coal(data, *sides)
            return self.distance(data, *sides) if np.isfinite(by_coal) else None
        except ModelError:
            return None

    def _ordered(self, first: frozenset[int], second: frozenset[int]) -> Iterator[tuple[int, int]]:
        for geom in sorted(first | second):
            kind = Geom(self._model.geom_type[geom])
            if kind not in _SUPPORTED:
                raise ModelError(
                    "distances to this shape cannot be checked",
                    path=self._realization.path,
                    where=simulate.geom_name(self._model, geom),
                    value=kind.name.removeprefix("mjGEOM_").lower(),
                    expected="plane, sphere, capsule, ellipsoid, cylinder, box or mesh",
                )
        for a in sorted(first):
            for b in sorted(second):
                yield a, b

    def _bound(self, data: mujoco.MjData, a: int, b: int) -> float:
        """Upper bound of the distance of two geoms, m; MuJoCo searches up to this distance."""
        centers = float(np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b]))
        return 1.0 + 2.0 * centers + float(self._model.geom_rbound[a] + self._model.geom_rbound[b])

    @staticmethod
    def _transform(data: mujoco.MjData, geom: int) -> Any:
        return coal.Transform3s(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom])

    def _shape(self, geom: int, plain: bool) -> Any:
        key = -1 - geom if plain else geom
        if key not in self._coal:
            self._coal[key] = self._build(geom, plain)
        return self._coal[key]

    def _build(self, geom: int, plain: bool) -> Any:
        kind = Geom(self._model.geom_type[geom])
        size = self._model.geom_size[geom]
        if kind == Geom.mjGEOM_SPHERE:
            return coal.Ellipsoid(size[0], size[0], size[0]) if plain else coal.Sphere(size[0])
        if kind == Geom.mjGEOM_CAPSULE:
            return coal.Capsule(size[0], 2.0 * size[1])
        if kind == Geom.mjGEOM_CYLINDER:
            return coal.Cylinder(size[0], 2.0 * size[1])
        if kind == Geom.mjGEOM_ELLIPSOID:
            return coal.Ellipsoid(*size)
        if kind == Geom.mjGEOM_BOX:
            return coal.Box(*(2.0 * size))
        if kind == Geom.mjGEOM_PLANE:
            return coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
        return self._hull(int(self._model.geom_dataid[geom]))

    def _hull(self, mesh: int) -> Any:
        points = hull_points(self._model, self._realization.spec, mesh)
        try:
            hull = ConvexHull(points)
        except QhullError as error:
            name = self._model.mesh(mesh).name
            raise ModelError(
                "a mesh without a convex hull",
                path=self._realization.path,
                where=f"mesh {name!r}",
                expected="vertices that do not lie in one plane",
            ) from error
        corner = np.full(len(points), -1)
        corner[hull.vertices] = np.arange(len(hull.vertices))
        return convex_hull(points[hull.vertices], corner[outward_faces(hull, points)])


def hull_points(model: mujoco.MjModel, spec: mujoco.MjSpec, mesh: int) -> Vector:
    """(n, 3) vertices whose convex hull is the collision shape, m, in the compiled mesh frame."""
    start = int(model.mesh_vertadr[mesh])
    points = model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])].astype(np.float64)
    graph = int(model.mesh_graphadr[mesh])
    named = spec.mesh(model.mesh(mesh).name)
    if graph < 0 or named is None or named.maxhullvert < 0:
        return np.asarray(points)
    # mesh_graph: numvert, numface, numvert edge addresses, numvert indices of the vertices.
    count = int(model.mesh_graph[graph])
    kept = model.mesh_graph[graph + 2 + count : graph + 2 + 2 * count]
    return np.asarray(points[kept])


def enabled_pairs(realization: Realization) -> list[tuple[str, str]]:
    """Pairs of bodies with geoms that can collide with each other, sorted by name."""
    return sorted(
        pair for pair, why in _disabling_reasons(realization) if why in ("", _SOME_DISABLED)
    )


def disabled_pairs(realization: Realization) -> list[tuple[tuple[str, str], str]]:
    """Pairs of bodies whose collision is disabled, with the reason, sorted by name.

    The list excludes geoms without a contact mask (visual shapes), bodies without relative motion,
    a body and its parent (unless the model turns off MuJoCo's filter), and geoms in an explicit
    ``pair``.
    """
    return sorted((pair, why) for pair, why in _disabling_reasons(realization) if why)


def _disabling_reasons(realization: Realization) -> Iterator[tuple[tuple[str, str], str]]:
    """Yield each pair of bodies that could collide, and the reason why it is disabled, or ''."""
    model = realization.model
    names = _body_names(realization)
    bodies = _bodies(model)
    explicit = {
        frozenset((int(first), int(second)))
        for first, second in zip(model.pair_geom1, model.pair_geom2, strict=True)
    }
    off = bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT))
    for a, b in combinations(sorted(bodies), 2):
        if are_one_or_linked(model, a, b):
            continue
        geoms = list(product(bodies[a], bodies[b]))
        paired = [frozenset(pair) in explicit for pair in geoms]
        masked = have_matching_masks(model, *np.transpose(geoms))
        first, second = sorted((names[a], names[b]))
        if off:
            why = "the option contact='disable' keeps them apart"
        elif are_excluded(model, a, b) and not all(paired):
            why = "an exclude element keeps them apart"
        elif not masked.any() and not any(paired):
            why = "contype and conaffinity keep them apart"
        elif not all(p or m for p, m in zip(paired, masked, strict=True)):
            why = _SOME_DISABLED
        else:
            why = ""
        yield (first, second), why


def _bodies(model: mujoco.MjModel) -> dict[int, list[int]]:
    """Body -> geoms that can collide: those with a contact mask or in an explicit pair."""
    paired = {int(g) for g in (*model.pair_geom1, *model.pair_geom2)}
    bodies: dict[int, list[int]] = {}
    for geom in range(model.ngeom):
        if model.geom_contype[geom] or model.geom_conaffinity[geom] or geom in paired:
            bodies.setdefault(int(model.geom_bodyid[geom]), []).append(geom)
    return bodies


def _body_names(realization: Realization) -> tuple[str, ...]:
    """Names of all bodies by index, the same as in the part ids of the realization."""
    return ("world", *realization.structure.body_parent)
