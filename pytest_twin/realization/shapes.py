"""Volume and inertia of shapes, in closed form and by volume integrals.

Formulas of solids: Beer, Johnston, "Vector Mechanics for Engineers: Dynamics", table of mass
moments of inertia; triangle meshes: Eberly, "Polyhedral Mass Properties (Revisited)", 2002.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def solid(geom: mujoco.MjsGeom, size: Vector) -> tuple[float, Vector] | None:
    """Volume [m^3] and (3,) principal moments per unit mass [m^2] of a solid primitive.

    None for other types of geom.
    """
    kinds = mujoco.mjtGeom
    a, b, c = (float(v) for v in size)
    if geom.type == kinds.mjGEOM_SPHERE:
        return 4 / 3 * math.pi * a**3, np.full(3, 2 / 5 * a * a)
    if geom.type == kinds.mjGEOM_BOX:
        return 8 * a * b * c, np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / 3
    if geom.type == kinds.mjGEOM_ELLIPSOID:
        volume = 4 / 3 * math.pi * a * b * c
        return volume, np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / 5
    if geom.type == kinds.mjGEOM_CYLINDER:
        across = (3 * a * a + 4 * b * b) / 12
        return 2 * math.pi * a * a * b, np.array([across, across, a * a / 2])
    if geom.type == kinds.mjGEOM_CAPSULE:
        barrel, ball = 2 * math.pi * a * a * b, 4 / 3 * math.pi * a**3
        volume = barrel + ball
        across = barrel * (3 * a * a + 4 * b * b) / 12
        across += ball * (2 / 5 * a * a + b * b + 3 / 4 * a * b)
        along = barrel * a * a / 2 + ball * 2 / 5 * a * a
        return volume, np.array([across, across, along]) / volume
    return None


def polyhedron(vertices: Vector, faces: NDArray[np.int32]) -> tuple[float, Vector, Vector] | None:
    """Volume [m^3], (3,) centroid [m], (3, 3) inertia per unit mass [m^2] of a closed mesh.

    The inertia is about the centroid. None for a mesh without volume.

    The function sums signed tetrahedra from the origin. The second moments of a tetrahedron with
    corners 0, a, b, c and volume V are V/20 (aa + bb + cc + ss), s = a + b + c.
    """
    corners = vertices[faces]
    volumes = np.linalg.det(corners) / 6
    total = float(volumes.sum())
    if abs(total) < 1e-15:
        return None
    sums = corners.sum(axis=1)
    centroid = np.einsum("i,ij->j", volumes, sums) / (4 * total)
    second = np.einsum("i,inj,ink->jk", volumes, corners, corners)
    second += np.einsum("i,ij,ik->jk", volumes, sums, sums)
    second = second / (20 * total) - np.outer(centroid, centroid)
    return abs(total), centroid, np.trace(second) * np.eye(3) - second


def hull(vertices: Vector) -> NDArray[np.int32] | None:
    """(m, 3) faces of the convex hull with outward normals; None where it has no volume."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        found = ConvexHull(vertices)
    except (QhullError, ValueError):
        return None
    corners = vertices[found.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, found.equations[:, :3]) < 0
    faces: NDArray[np.int32] = found.simplices.astype(np.int32)
    faces[inward] = faces[inward][:, ::-1]
    return faces
