"""Frames: links without mass and shape, the base, the tool centre point."""

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


def frame_bodies(asset: Asset) -> list[str]:
    """Return the bodies without mass and shape, which are frames and not faults."""
    return [
        body.name
        for body in asset.body.values()
        if not body.mass and not asset.shapes_of(body.name) and body.name not in asset.roots
    ]


def check(asset: Asset, evidence: Evidence) -> Iterator[Finding]:
    """Yield faults and unknown properties of frames."""
    yield from _names(asset)
    yield from _base(asset)
    yield from _tool(asset, evidence)
    yield from _far_frames(asset)


def _names(asset: Asset) -> Iterator[Finding]:
    for kind, name, place in asset.named:
        if kind in ("link", "joint", "body", "site") and not _PORTABLE.fullmatch(name):
            yield Finding(
                "frames.name",
                "info",
                place,
                f"{kind} '{name}'",
                "its name is not an identifier",
                name,
                None,
                "letters, digits and _, not starting with a digit",
                "USD and code generators rename it, and names differ between realizations",
                "choose a portable name in the normalized asset",
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
            "the base link has mass: tools that read URDF by KDL ignore it",
            root.mass,
            "kg",
            "a massless base link, with this link fixed to it",
            "a floating base weighs less in those tools",
            "compare the total mass of every realization",
        )
    if not _WORLD.search(root.name):
        yield Finding(
            "frames.mount_unknown",
            "unknown",
            root.place,
            f"link '{root.name}'",
            "how the base is mounted (fixed or not, where, which way is up) is not stated",
            None,
            None,
            None,
            "a tilted base changes the gravity torque of every joint",
            "put a level on the base, or fit the tilt to gravity torques at three poses",
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
                "the declared tool centre point is not a frame of the asset",
                evidence.tcp,
                None,
                "the name of a link or site",
                "every Cartesian comparison needs it",
                "correct `tcp:` in the evidence, or add the frame at its measured pose",
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
        "the tool centre point is not named"
        if not candidates
        else f"{len(candidates)} frames could be the tool centre point",
        " ".join(candidates[:8]) or None,
        None,
        "`tcp: FRAME` in the evidence file or in twin.yaml",
        "poses of different points differ by the length of the tool",
        "read the tool frame from the controller's setup, and declare it",
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
            yield Finding(
                "frames.far",
                "warning",
                edge.place,
                f"link '{name}'",
                "it lies far from the rest of the robot",
                float(away),
                "m",
                f"a distance of a few times {usual:.3g} m",
                "every frame after it is displaced, if its unit or origin is wrong",
                "compare its position with the drawing, and correct the unit",
            )
