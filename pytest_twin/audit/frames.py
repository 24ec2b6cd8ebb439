"""Frames: links that only mark a place, the base, the tool."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.finding import Finding

_PORTABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TOOL = re.compile(
    r"(^|[_/.-])(tcp|tool0?|tool_?cent(er|re)(_?point)?|ee|eef|end_?effector|flange"
    r"|gripper(_?(site|frame|link))?|attachment_site)([_/.-]|$)",
    re.IGNORECASE,
)
_WORLD = re.compile(r"(^|_)(world|map|odom)$", re.IGNORECASE)


def marks(asset: Asset) -> list[str]:
    """Bodies without mass and without shape: they mark a place and are no fault."""
    return [
        body.name
        for body in asset.body.values()
        if not body.mass and not asset.shapes_of(body.name) and body.name not in asset.roots
    ]


def check(asset: Asset, evidence: Evidence) -> Iterator[Finding]:
    """What is odd with, or unknown of, frames."""
    yield from _names(asset)
    yield from _base(asset)
    yield from _tool(asset, evidence)
    yield from _far(asset)


def _names(asset: Asset) -> Iterator[Finding]:
    for kind, name, place in asset.named:
        if kind in ("link", "joint", "body", "site") and not _PORTABLE.fullmatch(name):
            yield Finding(
                "frames.name",
                "info",
                place,
                f"{kind} '{name}'",
                "its name is no identifier",
                name,
                None,
                "letters, digits and _, no digit first",
                "USD and code generators rename it, and names no longer match across realizations",
                "a stable name, chosen once, in the normalized asset",
            )


def _base(asset: Asset) -> Iterator[Finding]:
    if asset.kind != "urdf" or len(asset.roots) != 1:
        return
    root = asset.body[asset.roots[0]]
    if root.mass:
        yield Finding(
            "frames.base_inertia",
            "info",
            root.inertial or root.place,
            f"link '{root.name}'",
            "the base itself has mass: tools that read URDF through KDL leave it out",
            root.mass,
            "kg",
            "a massless base frame with the body fixed to it",
            "a floating base then weighs less",
            "the same total mass in every realization",
        )
    if not _WORLD.search(root.name):
        yield Finding(
            "frames.mount_unknown",
            "unknown",
            root.place,
            f"link '{root.name}'",
            "how the base stands in the world (fixed, where, which way is up) is not said",
            None,
            None,
            None,
            "a tilted base turns gravity in every joint",
            "a level on the base; or gravity torques at three poses, fitted for tilt",
        )


def _tool(asset: Asset, evidence: Evidence) -> Iterator[Finding]:
    names = [*asset.body, *asset.sites]
    if evidence.tcp is not None:
        if evidence.tcp not in names:
            yield Finding(
                "frames.missing_tool",
                "critical",
                None if evidence.path is None else asset.place,
                f"frame '{evidence.tcp}'",
                "the declared tool centre point is no frame of the asset",
                evidence.tcp,
                None,
                "the name of a link or site",
                "every Cartesian comparison rests on it",
                "the name in the asset, or the frame added with its measured place",
            )
        return
    candidates = [name for name in names if _TOOL.search(name)]
    if len(candidates) == 1:
        return
    yield Finding(
        "frames.tool_unknown",
        "unknown",
        asset.place,
        f"robot '{asset.name}'",
        "which frame is the tool centre point is not said"
        if not candidates
        else f"{len(candidates)} frames could be the tool centre point",
        " ".join(candidates[:8]) or None,
        None,
        "one frame, declared as `tcp:` in the evidence or the twin",
        "poses compared at different points differ by the tool's length",
        "the controller's own tool frame, read from its setup",
    )


def _far(asset: Asset) -> Iterator[Finding]:
    """Frames that lie far outside the rest of the robot."""
    if len(asset.drawn) < 4:
        return
    positions = np.array([position for position, _ in asset.drawn.values()])
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    usual = float(np.quantile(distance, 0.75))
    for name, away in zip(asset.drawn, distance, strict=True):
        edge = asset.above.get(name)
        if edge is None or away < max(20 * usual, 1.0):
            continue
        if float(np.linalg.norm(edge.position)) > 0.5 * away:
            yield Finding(
                "frames.far",
                "warning",
                edge.place,
                f"link '{name}'",
                "it lies far outside the rest of the robot",
                float(away),
                "m",
                f"within a few times {usual:.3g} m",
                "a misplaced unit or origin",
                "its place in the drawing, with the unit",
            )
