"""Shapes of a robot's bodies as triangles, and poses of the bodies over time, for viewers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_MOST_TRIANGLES = 60_000
"""Largest number of triangles of a robot; beyond it, meshes are drawn as their convex hulls."""
_VISUAL_GROUPS = 3
"""Geoms of groups below this are visual, by MuJoCo's convention."""
_NOT_DRAWN = {mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD}


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """Bodies of one robot over time.

    Attributes:
        names: (b,) bodies, without the world.
        position: (n, b, 3) in the world, m.
        quaternion_wxyz: (n, b, 4) in the world.
    """

    names: tuple[str, ...]
    position: Floats
    quaternion_wxyz: Floats


@dataclass(frozen=True, slots=True)
class Triangles:
    """Surface of a body, in its frame.

    Attributes:
        vertices: (v, 3) m.
        faces: (f, 3) indices of vertices.
    """

    vertices: Floats
    faces: NDArray[np.int64]


def body_motion(model: mujoco.MjModel, joints: Sequence[str], position: Floats) -> BodyMotion:
    """Return the poses of all bodies.

    Args:
        joints: (j,) names of hinges and slides; other joints stay where the model starts, or follow
            by their equality.
        position: (n, j) rad or m; a missing value repeats the one before.
    """
    data = mujoco.MjData(model)
    addresses = [int(model.jnt_qposadr[model.joint(name).id]) for name in joints]
    followers = [
        (int(model.jnt_qposadr[first]), int(model.jnt_qposadr[second]), model.eq_data[at, :5])
        for at, (kind, first, second) in enumerate(
            zip(model.eq_type, model.eq_obj1id, model.eq_obj2id, strict=True)
        )
        if kind == mujoco.mjtEq.mjEQ_JOINT
        and second >= 0
        and int(model.jnt_qposadr[first]) not in addresses
    ]
    places, turns = [], []
    for row in position:
        known = np.isfinite(row)
        data.qpos[np.asarray(addresses, dtype=int)[known]] = row[known]
        for follower, leader, polynomial in followers:
            moved = data.qpos[leader] - model.qpos0[leader]
            data.qpos[follower] = model.qpos0[follower] + np.polyval(polynomial[::-1], moved)
        mujoco.mj_kinematics(model, data)
        places.append(data.xpos[1:].copy())
        turns.append(data.xquat[1:].copy())
    names = tuple(model.body(at).name or f"body_{at}" for at in range(1, model.nbody))
    return BodyMotion(names, np.array(places), np.array(turns))


def body_triangles(model: mujoco.MjModel) -> dict[str, Triangles]:
    """Return body -> its visible surface; its collision shapes where it has no visual ones."""
    geoms: dict[int, list[int]] = {}
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body and model.geom_type[geom] not in _NOT_DRAWN:
            geoms.setdefault(body, []).append(geom)
    hulls = int(model.mesh_facenum.sum()) > _MOST_TRIANGLES
    surfaces = {}
    for body, members in geoms.items():
        visual = [geom for geom in members if model.geom_group[geom] < _VISUAL_GROUPS]
        parts = [_surface(model, geom, hulls=hulls) for geom in visual or members]
        counts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        name = model.body(body).name or f"body_{body}"
        surfaces[name] = Triangles(
            np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts]),
            np.concatenate([
                np.asarray(part.faces, dtype=np.int64) + first
                for part, first in zip(parts, counts.tolist(), strict=True)
            ]),
        )  # fmt: skip
    return surfaces


def _surface(model: mujoco.MjModel, geom: int, *, hulls: bool) -> trimesh.Trimesh:
    kinds, size = mujoco.mjtGeom, model.geom_size[geom]
    kind = model.geom_type[geom]
    if kind == kinds.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        start, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        surface = trimesh.Trimesh(
            model.mesh_vert[first : first + count], model.mesh_face[start : start + faces],
            process=False,
        )  # fmt: skip
        surface = surface.convex_hull if hulls else surface
    elif kind == kinds.mjGEOM_BOX:
        surface = trimesh.creation.box(2.0 * size)
    elif kind == kinds.mjGEOM_CYLINDER:
        surface = trimesh.creation.cylinder(size[0], 2.0 * size[1], sections=24)
    elif kind == kinds.mjGEOM_CAPSULE:
        surface = trimesh.creation.capsule(2.0 * size[1], size[0], count=[12, 12])
    else:
        surface = trimesh.creation.icosphere(2)
        surface.apply_scale(size if kind == kinds.mjGEOM_ELLIPSOID else size[0])
    pose = np.eye(4)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = turn.reshape(3, 3), model.geom_pos[geom]
    surface.apply_transform(pose)
    return surface
