"""Build convex hulls for coal, in which a vertex may have at most 255 neighbours."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Vector = NDArray[np.float64]
Faces = NDArray[np.integer[Any]]

_DIRECTIONS = (4000, 1000, 250)
"""Numbers of directions of a coarser hull, which keeps the farthest vertex in each direction. Its
error is 2e-4 of the size of the shape with 4000 directions and 3e-3 with 250."""
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
"""Angle between consecutive points of an even spiral on the sphere, rad."""


def convex_hull(vertices: Vector, faces: Faces) -> coal.Convex:
    """Convex hull for coal; a coarser hull where a vertex has too many neighbours.

    Args:
        vertices: (n, 3) m, all on the hull.
        faces: (m, 3) indices, counterclockwise seen from outside.
    """
    try:
        return _convex(vertices, faces)
    except RuntimeError:
        for count in _DIRECTIONS:
            kept = vertices[np.unique((vertices @ _sphere(count).T).argmax(axis=0))]
            try:
                return _convex(kept, outward_faces(ConvexHull(kept), kept))
            except RuntimeError:
                continue
        raise


def outward_faces(hull: ConvexHull, points: Vector) -> Faces:
    """(m, 3) faces of the hull of ``points``, counterclockwise seen from outside."""
    faces = hull.simplices.copy()
    first, second, third = (points[faces[:, i]] for i in range(3))
    normals = np.cross(second - first, third - first)
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return np.asarray(faces)


def _convex(vertices: Vector, faces: Faces) -> coal.Convex:
    corners = coal.StdVec_Vec3s()
    corners.extend(list(vertices))
    triangles = coal.StdVec_Triangle()
    triangles.extend([coal.Triangle(*face) for face in faces.tolist()])
    return coal.Convex(corners, triangles)


def _sphere(count: int) -> Vector:
    """(count, 3) unit vectors, evenly distributed over the sphere (Fibonacci lattice)."""
    turn = np.arange(count) * _GOLDEN_ANGLE
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
