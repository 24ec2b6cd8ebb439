"""Compute volume, centroid, inertia and size of shapes as solids of uniform density.

Round primitives are approximated by polyhedra, at most 2 % too small. A mesh is replaced by its
convex hull, which is closed even if the mesh is not, and never smaller than the body.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pytest_twin.audit.asset import Asset, Shape, Vector
from pytest_twin.realization import shapes
from pytest_twin.realization.inertia import point_inertia

Faces = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Solid:
    """A body of uniform density, in the body's frame.

    Attributes:
        volume: volume, m^3.
        centroid: (3,) centroid, m.
        inertia: (3, 3) about the centroid, per unit mass, m^2.
        lower, upper: (3,) corners of the axis-aligned bounding box, m.
        points: (n, 3) vertices of its convex hulls, m.
    """

    volume: float
    centroid: Vector
    inertia: Vector
    lower: Vector
    upper: Vector
    points: Vector

    @property
    def size(self) -> float:
        """Return the diagonal of the bounding box, m."""
        return float(np.linalg.norm(self.upper - self.lower))

    @property
    def gyration(self) -> float:
        """Return the radius of gyration about the centroid, sqrt(tr(I) / 2 m), m."""
        # For a small shape far from the origin, rounding can make the trace negative.
        return float(np.sqrt(max(float(np.trace(self.inertia)), 0.0) / 2))

    def reach(self, point: Vector) -> float:
        """Return the distance from ``point`` (3,) to the farthest vertex, m."""
        return float(np.linalg.norm(self.points - point, axis=1).max())

    def outside(self, point: Vector) -> float:
        """Return the distance from ``point`` (3,) to the bounding box, 0 inside, m."""
        beyond = np.maximum(np.maximum(self.lower - point, point - self.upper), 0.0)
        return float(np.linalg.norm(beyond))


def triangles(shape: Shape) -> tuple[Vector, Faces] | None:
    """Return (n, 3) vertices in the body's frame, m, and (m, 3) faces; None without a surface."""
    found = _local(shape)
    if found is None:
        return None
    vertices, faces = found
    return vertices @ shape.rotation.T + shape.position, faces


def _local(shape: Shape) -> tuple[Vector, Faces] | None:
    if shape.triangles is not None:
        return shape.triangles.vertices, shape.triangles.faces
    if shape.kind == "mesh" or not shape.size or min(shape.size) <= 0:
        return None
    return _primitive(shape.kind, shape.size)


@lru_cache(maxsize=256)
def _primitive(kind: str, size: tuple[float, ...]) -> tuple[Vector, Faces] | None:
    """Return read-only vertices [m] and faces of a box, sphere, ellipsoid, cylinder or capsule."""
    import trimesh

    if kind == "box":
        made = trimesh.creation.box(extents=size)
    elif kind == "sphere":
        made = trimesh.creation.icosphere(subdivisions=3, radius=size[0])
    elif kind == "ellipsoid":
        made = trimesh.creation.icosphere(subdivisions=3)
        made.apply_scale(size)
    elif kind == "cylinder":
        made = trimesh.creation.cylinder(radius=size[0], height=size[1], sections=48)
    elif kind == "capsule":
        made = trimesh.creation.capsule(radius=size[0], height=size[1], count=[24, 24])
    else:
        return None
    vertices = np.array(made.vertices, dtype=np.float64)
    faces = np.array(made.faces, dtype=np.int32)
    vertices.setflags(write=False)
    faces.setflags(write=False)
    return vertices, faces


class Geometry:
    """Computes and caches the solids of an asset's shapes and bodies."""

    def __init__(self, asset: Asset) -> None:
        self.asset = asset
        self._shapes: dict[int, Solid | None] = {}
        self._bodies: dict[tuple[str, str | None], Solid | None] = {}
        self._hulls: dict[tuple[object, ...], tuple[Vector, Faces] | None] = {}
        self._properties: dict[tuple[object, ...], tuple[float, Vector, Vector] | None] = {}

    def shape(self, shape: Shape) -> Solid | None:
        """Return a shape's convex hull as a solid; None if it has no volume."""
        if id(shape) not in self._shapes:
            self._shapes[id(shape)] = self._solid(shape)
        return self._shapes[id(shape)]

    def body(self, name: str, role: str | None = None) -> Solid | None:
        """Merge a body's shapes of ``role`` into one solid; by default its visual shapes if any.

        The volume of an overlap counts twice.
        """
        key = (name, role)
        if key not in self._bodies:
            own = self.asset.shapes_of(name)
            chosen = [self.shape(s) for s in own if s.role == (role or "visual")]
            if role is None and not any(chosen):
                chosen = [self.shape(s) for s in own if s.role == "collision"]
            self._bodies[key] = merge_solids(solid for solid in chosen if solid is not None)
        return self._bodies[key]

    def hull_volume(self, shape: Shape) -> float:
        """Return the volume of the convex hull, m^3; 0 if there is none."""
        solid = self.shape(shape)
        return 0.0 if solid is None else solid.volume

    def _solid(self, shape: Shape) -> Solid | None:
        found = self.hull(shape)
        properties = self._own_properties(shape)
        if found is None or properties is None:
            return None
        volume, centroid, inertia = properties
        axes = shape.rotation
        vertices = found[0] @ axes.T + shape.position
        return Solid(
            volume,
            axes @ centroid + shape.position,
            axes @ inertia @ axes.T,
            vertices.min(axis=0),
            vertices.max(axis=0),
            vertices,
        )

    def _own_properties(self, shape: Shape) -> tuple[float, Vector, Vector] | None:
        """Return volume, centroid and inertia of the hull in the shape's own frame."""
        key = _key(shape)
        if key not in self._properties:
            found = self.hull(shape)
            self._properties[key] = None if found is None else shapes.polyhedron(*found)
        return self._properties[key]

    def hull(self, shape: Shape) -> tuple[Vector, Faces] | None:
        """Return (n, 3) vertices [m] and (m, 3) faces of the convex hull, in the shape's frame."""
        key = _key(shape)
        if key not in self._hulls:
            self._hulls[key] = _hull_of(_local(shape))
        return self._hulls[key]


def _key(shape: Shape) -> tuple[object, ...]:
    """Return a key that is equal for shapes of the same form and size at any pose."""
    if shape.file is not None:
        return (shape.file, *shape.scale.tolist())
    return (shape.kind, shape.size)


def _hull_of(found: tuple[Vector, Faces] | None) -> tuple[Vector, Faces] | None:
    if found is None:
        return None
    vertices, _ = found
    faces = shapes.hull(vertices)
    if faces is None:
        return None
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3).astype(np.int32)


def merge_solids(solids: Iterable[Solid]) -> Solid | None:
    """Merge several solids of equal density into one; None if there are none."""
    found = list(solids)
    if not found:
        return None
    volume = sum(solid.volume for solid in found)
    centroid = sum((solid.volume * solid.centroid for solid in found), np.zeros(3)) / volume
    inertia = np.zeros((3, 3))
    for solid in found:
        share = solid.volume / volume
        inertia += share * (solid.inertia + point_inertia(1.0, solid.centroid - centroid))
    return Solid(
        float(volume),
        centroid,
        inertia,
        np.min([solid.lower for solid in found], axis=0),
        np.max([solid.upper for solid in found], axis=0),
        np.vstack([solid.points for solid in found]),
    )
