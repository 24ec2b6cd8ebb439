"""Find the prims of links and joints in a USD stage."""

from __future__ import annotations

from typing import Any


def display_name(prim: Any) -> str:
    """Original name of a prim: its display name, or its name where it has none."""
    return str(prim.GetDisplayName() or prim.GetName())


def link_prims(stage: Any) -> dict[str, Any]:
    """Link -> prim, for rigid bodies and for frames between and below them.

    An Xform that only groups the meshes of a shape is not a link.
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
    """Whether an Xform only groups the meshes of one shape."""
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
