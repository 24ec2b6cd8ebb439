"""Content of parts for shapes and contacts."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.realization.features.canonical import (
    as_list,
    as_rounded_list,
    digest_of,
    rotation_of,
    rows_of_element,
)
from pytest_twin.realization.features.elements import Elements


def shape(elements: Elements, geom: int) -> dict[str, Any]:
    """Type, size and pose of a geom in its body."""
    model = elements.model
    kind = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
    content: dict[str, Any] = {
        "type": kind,
        "position [m]": as_rounded_list(model.geom_pos[geom]),
        "quaternion": rotation_of(model.geom_quat[geom]),
    }
    data = int(model.geom_dataid[geom])
    if kind in ("mesh", "sdf") and data >= 0:
        content["mesh"] = elements.mesh[data]
    elif kind == "hfield" and data >= 0:
        content["height field"] = elements.hfield[data]
    elif kind != "plane":
        # The size of a plane changes the rendering only.
        content["size [m]"] = as_rounded_list(model.geom_size[geom])
    return content


def collision(elements: Elements, body: int) -> dict[str, Any]:
    """Collision geoms of a body with their contact parameters."""
    model = elements.model
    return {
        "geoms": [
            {
                "name": elements.geom[g],
                **shape(elements, g),
                "contype": int(model.geom_contype[g]),
                "conaffinity": int(model.geom_conaffinity[g]),
                "condim": int(model.geom_condim[g]),
                "priority": int(model.geom_priority[g]),
                "friction": as_list(model.geom_friction[g]),
                "solmix": float(model.geom_solmix[g]),
                "solref": as_list(model.geom_solref[g]),
                "solimp": as_list(model.geom_solimp[g]),
                "margin [m]": float(model.geom_margin[g]),
                "gap [m]": float(model.geom_gap[g]),
                "surface velocity": as_list(model.geom_surfacevel[g]),
                "adhesion [N]": float(model.geom_adhesion[g]),
            }
            for g in elements.geoms_of(body)
        ]
    }


def visual(elements: Elements, geom: int) -> dict[str, Any]:
    """A visual geom; a check may compute its distance."""
    data = int(elements.model.geom_dataid[geom])
    content = {
        "body": elements.body[int(elements.model.geom_bodyid[geom])],
        **shape(elements, geom),
    }
    return content | (mesh(elements, data) if "mesh" in content else {})


def weld_groups(elements: Elements) -> dict[str, Any]:
    """Groups of welded bodies and their parents, between which MuJoCo does not detect contacts."""
    model, body = elements.model, elements.body
    found = {}
    for b in range(model.nbody):
        if elements.geoms_of(b):
            weld = int(model.body_weldid[b])
            above = int(model.body_weldid[model.body_parentid[weld]])
            found[body[b]] = [body[weld], body[above]]
    return found


def collision_assets(elements: Elements, kinds: set[str]) -> set[int]:
    """Indices of meshes or height fields of collision geoms."""
    model = elements.model
    found = set()
    for geom in range(model.ngeom):
        kind = mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
        if kind in kinds and elements.can_collide[geom] and model.geom_dataid[geom] >= 0:
            found.add(int(model.geom_dataid[geom]))
    return found


def mesh(elements: Elements, mesh: int) -> dict[str, Any]:
    """Digests of vertices, faces and convex hull of a mesh."""
    model = elements.model
    vertices = rows_of_element(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum, mesh)
    faces = rows_of_element(model.mesh_face, model.mesh_faceadr, model.mesh_facenum, mesh)
    content: dict[str, Any] = {
        "vertices": len(vertices),
        "faces": len(faces),
        "vertex positions": digest_of(vertices),
        "face indices": digest_of(faces),
        "hull": digest_of(_hull(elements, mesh)),
    }
    if model.mesh_octnum[mesh] > 0:
        for name in ("oct_depth", "oct_child", "oct_aabb", "oct_coeff"):
            array = getattr(model, name)
            content[name] = digest_of(
                rows_of_element(array, model.mesh_octadr, model.mesh_octnum, mesh)
            )
    return content


def _hull(elements: Elements, mesh: int) -> NDArray[Any]:
    model = elements.model
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        return np.empty(0, dtype=np.int32)
    later = [int(a) for a in model.mesh_graphadr if a > start]
    return np.asarray(model.mesh_graph[start : min(later, default=len(model.mesh_graph))])


def hfield(elements: Elements, hfield: int) -> dict[str, Any]:
    """Size of a height field, and digest of its elevation."""
    model = elements.model
    rows, columns = int(model.hfield_nrow[hfield]), int(model.hfield_ncol[hfield])
    start = int(model.hfield_adr[hfield])
    return {
        "size [m]": as_list(model.hfield_size[hfield]),
        "rows": rows,
        "columns": columns,
        "elevation": digest_of(model.hfield_data[start : start + rows * columns]),
    }


def pairs(elements: Elements) -> dict[str, Any]:
    """Explicit contact pairs, and excluded pairs of bodies."""
    model = elements.model
    return {
        "declared": [
            {
                "geoms": [elements.geom[model.pair_geom1[p]], elements.geom[model.pair_geom2[p]]],
                "condim": int(model.pair_dim[p]),
                "friction": as_list(model.pair_friction[p]),
                "solref": as_list(model.pair_solref[p]),
                "solref friction": as_list(model.pair_solreffriction[p]),
                "solimp": as_list(model.pair_solimp[p]),
                "margin [m]": float(model.pair_margin[p]),
                "gap [m]": float(model.pair_gap[p]),
                "adhesion [N]": float(model.pair_adhesion[p]),
            }
            for p in range(model.npair)
        ],
        "disabled": [
            [elements.body[int(s) >> 16], elements.body[int(s) & 0xFFFF]]
            for s in model.exclude_signature
        ],
    }
