"""Rows of the loss matrix on bodies: mass, frames, shapes, contact and sensors."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.description import Description, LinkFacts
from pytest_twin.asset.loss.matrix import Item, Row, Verdict
from pytest_twin.asset.loss.table import (
    CLOSE,
    EXACT,
    SINGLE,
    count_and_names,
    format_numbers,
    largest_magnitude,
    table,
)
from pytest_twin.metrics.pose import inverse
from pytest_twin.realization.tree import RigidTree

Vector = NDArray[np.float64]


def links(source: Description, target: Description) -> Row:
    """Compare mass, centre of mass and inertia of each body."""
    massive = {name for name, link in source.links.items() if link.mass or link.inertia.any()}
    items = []
    for name in sorted(massive | set(target.links)):
        before, after = source.links.get(name), target.links.get(name)
        if before is None or after is None:
            if name in massive:
                items.append(Item(name, "lost", f"{source.links[name].mass:.6g} kg", None))
            continue
        scale = max(before.mass, 1e-3)
        apart = {
            "mass": (abs(before.mass - after.mass), scale, before.mass, after.mass, "kg"),
            "centre of mass": (
                largest_magnitude(before.com - after.com) if before.mass else 0.0,
                1.0,
                before.com,
                after.com,
                "m",
            ),
            "inertia": (
                largest_magnitude(before.inertia - after.inertia),
                max(largest_magnitude(before.inertia), 1e-6),
                np.linalg.eigvalsh(before.inertia),
                np.linalg.eigvalsh(after.inertia),
                "kg*m^2",
            ),
        }
        for what, (difference, size, old, new, unit) in apart.items():
            if difference > EXACT * size:
                values = (f"{what} {format_numbers(value)} {unit}" for value in (old, new))
                items.append(Item(name, "changed", *values))
    return table(
        "links",
        f"{len(source.links)} links, {len(massive)} with mass",
        f"{len(target.links)} bodies",
        "mass, centre of mass and principal inertia of each body",
        items,
        critical=bool(items) and _has_moved_away(source, target),
    )


def _has_moved_away(source: Description, target: Description) -> bool:
    """Whether the total inertia of a rigid group of links changed.

    A conversion may merge such links, which does not change the motion.
    """
    if not target.links:
        return False
    tree = source.dynamics
    assert isinstance(tree, RigidTree)
    head: dict[str, str] = {}
    for name, body in tree.bodies.items():
        fixed = body.joint is None and body.parent is not None
        head[name] = head[body.parent] if fixed and body.parent is not None else name
    poses = tree.poses({})
    groups: dict[str, list[str]] = {}
    for name, first in head.items():
        groups.setdefault(first, []).append(name)
    for first, names in groups.items():
        back = inverse(poses[first])
        before, after = (
            sum(
                (
                    _moments(held.links[name], back @ poses[name])
                    for name in names
                    if name in held.links
                ),
                np.zeros((4, 4)),
            )
            for held in (source, target)
        )
        if largest_magnitude(before - after) > SINGLE * max(largest_magnitude(before), 1e-3):
            return True
    return False


def _moments(link: LinkFacts, pose: Vector) -> Vector:
    """Return the (4, 4) pseudo-inertia in another frame; it is additive (Wensing et al., 2018)."""
    second = np.trace(link.inertia) / 2 * np.eye(3) - link.inertia
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = second + link.mass * np.outer(link.com, link.com)
    matrix[:3, 3] = matrix[3, :3] = link.mass * link.com
    matrix[3, 3] = link.mass
    moved: Vector = pose @ matrix @ pose.T
    return moved


def frames(source: Description, target: Description) -> Row:
    """Compare the frames that have a pose in the target with the source's links."""
    missing = sorted(set(source.dynamics.frames) - set(target.dynamics.frames))
    items = [Item(name, "lost", "a frame", None) for name in missing]
    count = len(source.dynamics.frames)
    return table(
        "frames",
        str(count),
        str(count - len(missing)),
        "a pose of every frame in the target",
        items,
        critical=bool(missing),
    )


def shapes(source: Description, target: Description) -> Row:
    """Compare kind and position of every collision shape, link by link."""
    items = []
    for link in sorted(set(source.shapes) | set(target.shapes)):
        before, after = source.shapes.get(link, ()), target.shapes.get(link, ())
        if len(before) != len(after):
            verdict: Verdict = "lost" if len(after) < len(before) else "changed"
            values = ("; ".join(map(str, held)) or None for held in (before, after))
            items.append(Item(link, verdict, *values))
            continue
        for one, two in zip(before, after, strict=True):
            size = max(1.0, largest_magnitude(one.upper - one.lower))
            if one.kind != two.kind or one.apart(two) > CLOSE * size:
                items.append(Item(link, "changed", str(one), str(two)))
    count = sum(map(len, source.shapes.values())), sum(map(len, target.shapes.values()))
    return table(
        "collision shapes",
        str(count[0]),
        str(count[1]),
        f"kind and bounding box of each shape in its link, to {CLOSE:g} m",
        items,
        empty=not any(count),
    )


def disabled_pairs(source: Description, target: Description) -> Row:
    """Compare the pairs of links whose collision is disabled."""
    fresh = target.disabled_pairs - source.disabled_pairs
    lost = source.disabled_pairs - target.disabled_pairs
    items = [Item(_pair(pair), "lost", "disabled", None) for pair in sorted(map(sorted, lost))]
    items += [
        Item(_pair(pair), "changed", "not stated", "disabled")
        for pair in sorted(map(sorted, fresh))
    ]
    return table(
        "disabled pairs",
        f"{len(source.disabled_pairs)} (URDF cannot state any)",
        f"{len(target.disabled_pairs)} disabled",
        "pairs of bodies with shapes whose collision the engine disables",
        items,
        empty=not source.disabled_pairs and not target.disabled_pairs,
    )


def _pair(pair: Iterable[str]) -> str:
    return " and ".join(pair)


def contact(source: Description, target: Description) -> Row:
    """Compare contact parameters, stated or default."""
    stated = {name: f"{count} times" for name, count in source.contact.items()}
    held = {name: f"{count} shapes" for name, count in target.contact.items()}
    items = [Item(name, "lost", value, None) for name, value in stated.items()]
    if not stated:
        items = [
            Item(name, "changed", "not stated", f"{value}, the engine's default")
            for name, value in held.items()
        ]
    return table(
        "contact materials",
        count_and_names(stated),
        count_and_names(held),
        "friction of each shape that collides",
        items,
        empty=not stated and not held,
    )


def sensors(source: Description, target: Description) -> Row:
    """Compare frames of sensors, and check for a signal in the target."""
    items = []
    for name, kind in source.sensors.items():
        held = target.sensors.get(name)
        if held is None:
            items.append(Item(name, "lost", kind, None))
        elif held == "site":
            items.append(Item(name, "changed", kind, "a site: the frame without a signal"))
    kept = sum(name in target.sensors for name in source.sensors)
    return table(
        "sensors",
        count_and_names(source.sensors),
        f"{kept} sites",
        "sites and sensors of the compiled model",
        items,
        empty=not source.sensors,
    )
