"""Add the visual shapes of a URDF to its MuJoCo spec; they do not collide and have no mass."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.realization.node import Node
from pytest_twin.realization.urdf import Robot, origin

Vector = NDArray[np.float64]
GROUP = 2
"""Geom group that MuJoCo's viewer shows by default; the group of collision shapes is hidden."""


def add(spec: mujoco.MjSpec, robot: Robot, mesh_paths: dict[str, Path]) -> None:
    """Add all visual shapes of a normalized URDF to their bodies.

    Args:
        spec: changed in place.
        mesh_paths: mesh of the spec -> its file; the meshes of visual shapes are added.
    """
    colours = {
        node.attributes.get("name", ""): colour
        for node in robot.node.all("material")
        if (colour := _colour(node)) is not None
    }
    names = {path: name for name, path in mesh_paths.items()}
    for link in robot.links.values():
        body = spec.worldbody if link.name == "world" else spec.body(link.name)
        for visual in link.node.all("visual"):
            geometry = visual.find("geometry")
            for shape in [] if geometry is None else geometry.children:
                details = _shape(spec, shape, names, mesh_paths)
                if details is None:
                    continue
                position, axes = origin(visual)
                quaternion = np.empty(4)
                mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(axes).ravel())
                made = body.add_geom(
                    pos=position,
                    quat=quaternion,
                    contype=0,
                    conaffinity=0,
                    group=GROUP,
                    mass=0,
                    **details,
                )
                made.name = _free_name(spec, visual.attributes.get("name", f"{link.name}_visual"))
                material = visual.find("material")
                if material is not None:
                    named = colours.get(material.attributes.get("name", ""))
                    colour = _colour(material)
                    colour = named if colour is None else colour
                    if colour is not None:
                        made.rgba = colour


def _free_name(spec: mujoco.MjSpec, name: str) -> str:
    taken = spec.geom(name) is not None
    while taken:
        name += "_visual"
        taken = spec.geom(name) is not None
    return name


def _shape(
    spec: mujoco.MjSpec, shape: Node, names: dict[Path, str], mesh_paths: dict[str, Path]
) -> dict[str, Any] | None:
    kinds = mujoco.mjtGeom
    if shape.tag == "mesh":
        path = shape.path.parent / shape.attributes["filename"]
        if path not in names:
            name = path.stem
            while name in mesh_paths:
                name += "_visual"
            made = spec.add_mesh(name=name)
            made.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            names[path] = name
            mesh_paths[name] = path
        return {"type": kinds.mjGEOM_MESH, "meshname": names[path]}
    if shape.tag == "box":
        size = shape.numbers("size", None, size=3, unit="m") / 2
        kind = kinds.mjGEOM_BOX
    elif shape.tag == "sphere":
        size = np.array([shape.number("radius", None, unit="m"), 0.0, 0.0])
        kind = kinds.mjGEOM_SPHERE
    elif shape.tag in ("cylinder", "capsule"):
        half = shape.number("length", None, unit="m") / 2
        size = np.array([shape.number("radius", None, unit="m"), half, 0.0])
        kind = kinds.mjGEOM_CYLINDER if shape.tag == "cylinder" else kinds.mjGEOM_CAPSULE
    else:
        return None
    used = {"box": 3, "sphere": 1}.get(shape.tag, 2)
    return {"type": kind, "size": size} if (size[:used] > 0).all() else None


def _colour(material: Node) -> Vector | None:
    node = material.find("color")
    if node is None or len(node.attributes.get("rgba", "").split()) != 4:
        return None
    return np.clip(node.numbers("rgba", None, size=4), 0.0, 1.0)
