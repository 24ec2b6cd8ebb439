"""Complete a converted stage by what NVIDIA's SimReady profile ``Robot-Body`` requires of it.

Nothing here changes how the robot moves: normals and materials of surfaces, and what the
converter leaves to a simulator's defaults, stated.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.realization.urdf import Robot
from pytest_twin.realization.urdf_tree import SCALAR
from pytest_twin.realization.usd_names import display_name

_GREY = 0.5
"""Diffuse colour of a surface for which the URDF states no material."""
_SIDES = {"revolute": "angular", "continuous": "angular", "prismatic": "linear"}


def complete(stage: Any, robot: Robot) -> None:
    """Add normals, materials, drives and the settings of Newton and MuJoCo to a stage."""
    from pxr import UsdGeom, UsdPhysics

    surfaces: set[bytes] = set()
    for prim in _shapes(stage, UsdGeom.Tokens.default_):
        _bind_material(stage, prim)
        if prim.IsA(UsdGeom.Mesh):
            surfaces.add(_signature(UsdGeom.Mesh(prim)))
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            _add_normals(UsdGeom.Mesh(prim))
        if prim.HasAPI(UsdPhysics.ArticulationRootAPI):
            attribute = prim.GetAttribute("newton:selfCollisionEnabled")
            attribute.Set(attribute.Get())
    for prim in _shapes(stage, UsdGeom.Tokens.guide):
        # MuJoCo's schema is not registered in OpenUSD; its names are written all the same.
        prim.AddAppliedSchema("MjcCollisionAPI")
        if prim.HasAPI(UsdPhysics.MeshCollisionAPI):
            prim.AddAppliedSchema("MjcMeshCollisionAPI")
        if prim.IsA(UsdGeom.Mesh) and _signature(UsdGeom.Mesh(prim)) in surfaces:
            # A viewer would draw both surfaces in the same place.
            UsdGeom.Imageable(prim).MakeInvisible()
    _add_drives(stage, robot)


def _shapes(stage: Any, purpose: str) -> Iterator[Any]:
    from pxr import UsdGeom

    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Gprim) and UsdGeom.Imageable(prim).ComputePurpose() == purpose:
            yield prim


def _signature(mesh: Any) -> bytes:
    """Bytes that two meshes share if they are the same surface in the same place."""
    from pxr import Usd

    matrix = mesh.ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    return b"".join(
        np.asarray(values).tobytes()
        for values in (
            np.round(np.array(matrix), 6) + 0.0,
            mesh.GetPointsAttr().Get(),
            mesh.GetFaceVertexIndicesAttr().Get(),
        )
    )


def _add_normals(mesh: Any) -> None:
    """Add one normal for each face, by Newell's method, to a mesh without normals."""
    from pxr import UsdGeom, Vt

    stated = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals").HasAuthoredValue()
    subdivided = mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none
    if subdivided or stated or mesh.GetNormalsAttr().HasAuthoredValue():
        return
    points = np.array(mesh.GetPointsAttr().Get(), dtype=np.float64).reshape(-1, 3)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(), dtype=np.int64)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(), dtype=np.int64)
    normals = face_normals(points, corners, counts).astype(np.float32)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.uniform)


def face_normals(
    points: NDArray[np.float64], corners: NDArray[np.int64], counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """(faces, 3) unit normals of polygons; that of a face without area is z.

    Args:
        points: (n, 3) vertices.
        corners: indices of the vertices of all faces, one face after the other.
        counts: (faces,) number of vertices of each face, at least 1.
    """
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    following = np.arange(len(corners)) + 1
    following[starts + counts - 1] = starts
    # From the first vertex of the face, because far from the origin the products lose digits.
    offsets = points[corners] - np.repeat(points[corners[starts]], counts, axis=0)
    sums = np.add.reduceat(np.cross(offsets, offsets[following]), starts, axis=0)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    normals: NDArray[np.float64] = np.where(
        lengths > 0, sums / np.where(lengths > 0, lengths, 1.0), [0.0, 0.0, 1.0]
    )
    return normals


def _bind_material(stage: Any, prim: Any) -> None:
    """Bind a neutral grey to a visible surface without a material."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade

    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    if material:
        return
    scope = stage.GetDefaultPrim().GetPath().AppendChild("Materials")
    path = scope.AppendChild("material_not_stated")
    material = UsdShade.Material.Get(stage, path)
    if not material:
        UsdGeom.Scope.Define(stage, scope)
        material = UsdShade.Material.Define(stage, path)
        shader = UsdShade.Shader.Define(stage, path.AppendChild("PreviewSurface"))
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(_GREY))
        surface = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(surface)
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)


def _add_drives(stage: Any, robot: Robot) -> None:
    """State the effort limit of each joint as the largest force of its drive.

    A URDF states no gains: stiffness and damping of the drive are 0, so that it does nothing until
    someone sets them.
    """
    from pxr import UsdPhysics

    for prim in stage.Traverse():
        joint = robot.joints.get(display_name(prim)) if prim.IsA(UsdPhysics.Joint) else None
        if joint is None or joint.type not in SCALAR:
            continue
        prim.AddAppliedSchema("MjcJointAPI")
        if not joint.effort or prim.HasAPI("NewtonMimicAPI"):
            continue
        drive = UsdPhysics.DriveAPI.Apply(prim, _SIDES[joint.type])
        drive.CreateMaxForceAttr(joint.effort)
        drive.CreateStiffnessAttr(0.0)
        drive.CreateDampingAttr(0.0)
