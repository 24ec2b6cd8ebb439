"""Frames: links without mass and shape, the base, the tool centre point."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from pytest_twin.audit.asset import Asset, Vector
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.finding import Finding, finding_of
from pytest_twin.audit.geometry import Geometry

_PORTABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TOOL = re.compile(
    r"(^|[_/.-])(tcp|tool0?|tool_?cent(er|re)(_?point)?|ee|eef|end_?effector|flange"
    r"|gripper(_?(site|frame|link))?|attachment_site)([_/.-]|$)",
    re.IGNORECASE,
)
_WORLD = re.compile(r"(^|_)(world|map|odom)$", re.IGNORECASE)


def frame_bodies(asset: Asset) -> list[str]:
    """Return the bodies without mass and shape, which are frames and not faults."""
    return [
        body.name
        for body in asset.body.values()
        if not body.mass and not asset.shapes_of(body.name) and body.name not in asset.roots
    ]


def check(asset: Asset, evidence: Evidence, geometry: Geometry) -> Iterator[Finding]:
    """Yield faults and unknown properties of frames."""
    yield from _names(asset)
    yield from _base(asset)
    yield from _tool(asset, evidence)
    yield from _far_frames(asset)
    yield from _gaps(asset, geometry)


def _names(asset: Asset) -> Iterator[Finding]:
    for kind, name, place in asset.named:
        if kind in ("link", "joint", "body", "site") and not _PORTABLE.fullmatch(name):
            yield finding_of("frames.name", place, f"{kind} '{name}'", name)


def _base(asset: Asset) -> Iterator[Finding]:
    if asset.kind != "urdf" or len(asset.roots) != 1:
        return
    root = asset.body[asset.roots[0]]
    if root.mass:
        yield finding_of(
            "frames.base_inertia", root.inertial or root.place, f"link '{root.name}'", root.mass
        )
    if not _WORLD.search(root.name):
        yield finding_of("frames.mount_unknown", root.place, f"link '{root.name}'")


def _tool(asset: Asset, evidence: Evidence) -> Iterator[Finding]:
    names = [*asset.body, *asset.sites]
    if evidence.tcp is not None:
        if evidence.tcp not in names:
            yield finding_of(
                "frames.missing_tool",
                None if evidence.path is None else asset.place,
                f"frame '{evidence.tcp}'",
                evidence.tcp,
            )
        return
    candidates = [name for name in names if _TOOL.search(name)]
    if len(candidates) == 1:
        return
    yield finding_of(
        "frames.tool_unknown",
        asset.place,
        f"robot '{asset.name}'",
        " ".join(candidates[:8]) or None,
        title="the tool centre point is not named"
        if not candidates
        else f"{len(candidates)} frames could be the tool centre point",
    )


def _far_frames(asset: Asset) -> Iterator[Finding]:
    """Yield findings of frames far away from the rest of the robot."""
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
            yield finding_of(
                "frames.far",
                edge.place,
                f"link '{name}'",
                float(away),
                expected=f"a distance of a few times {usual:.3g} m",
            )


def _gaps(asset: Asset, geometry: Geometry) -> Iterator[Finding]:
    """Yield findings of links whose shape is farther from their carrier's than both are large.

    The carrier is the next link towards the base that has a shape.
    """
    boxes: dict[str, tuple[Vector, Vector]] = {}
    for name, (position, rotation) in asset.drawn.items():
        solids = (geometry.body(name, role) for role in ("visual", "collision"))
        points = [solid.points for solid in solids if solid is not None]
        if points:
            placed = np.vstack(points) @ rotation.T + position
            boxes[name] = placed.min(axis=0), placed.max(axis=0)
    carriers: dict[str, str | None] = dict.fromkeys(asset.roots)
    for edge in asset.in_order():
        carrier = edge.parent if edge.parent in boxes else carriers[edge.parent]
        carriers[edge.child] = carrier
        if carrier is None or edge.child not in boxes or carrier in asset.roots:
            # Bodies of a scene stand apart from its floor.
            continue
        (low, high), (lower, upper) = boxes[carrier], boxes[edge.child]
        gap = float(np.linalg.norm(np.maximum(np.maximum(low - upper, lower - high), 0.0)))
        size = max(float(np.linalg.norm(high - low)), float(np.linalg.norm(upper - lower)))
        if gap > size:
            yield finding_of(
                "frames.gap",
                edge.place,
                f"link '{edge.child}'",
                gap,
                title=f"a gap separates its shape from that of link '{carrier}', which carries it",
                expected=f"less than {size:.3g} m, the size of the larger one",
            )
