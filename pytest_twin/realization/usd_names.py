"""Which prim of a stage is which link or joint."""

from __future__ import annotations

from typing import Any


def display_name(prim: Any) -> str:
    """The name that it had before USD's rules for names: its display name, or its own."""
    return str(prim.GetDisplayName() or prim.GetName())


def link_prims(stage: Any) -> dict[str, Any]:
    """Link -> its prim: rigid bodies, and the frames between them and below.

    A shape of several meshes is an Xform too; it is none of a link's.
    """
    from pxr import Usd

    found: dict[str, Any] = {}
    scope = stage.GetDefaultPrim().GetChild("Geometry")
    for prim in Usd.PrimRange(scope) if scope else ():
        if prim.GetTypeName() != "Xform" or _is_shape(prim):
            continue
        found.setdefault(display_name(prim), prim)
    return found


def _is_shape(prim: Any) -> bool:
    """Whether an Xform only gathers the meshes of one shape."""
    from pxr import Usd, UsdGeom, UsdPhysics

    if prim.HasAPI(UsdPhysics.RigidBodyAPI) or prim.HasAPI(UsdPhysics.MassAPI):
        return False
    below = [p for p in Usd.PrimRange(prim) if p != prim]
    return (
        bool(below)
        and all(
            p.IsA(UsdGeom.Gprim) or p.GetTypeName() in ("Xform", "GeomSubset", "Scope")
            for p in below
        )
        and any(c.IsA(UsdGeom.Gprim) for c in prim.GetChildren())
    )
