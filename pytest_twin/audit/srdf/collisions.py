"""Check the link pairs whose collisions an SRDF disables, and find colliding pairs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from scipy.stats import qmc

from pytest_twin.audit import self_collision
from pytest_twin.audit.finding import Finding, finding_of
from pytest_twin.audit.geometry import Geometry
from pytest_twin.audit.self_collision import BASE_POSE, PoseResult
from pytest_twin.audit.srdf import states
from pytest_twin.audit.srdf.document import Srdf, label_of, missing_attribute, place_of
from pytest_twin.realization.node import Node

_SAMPLES = 12
"""Number of random poses besides the base pose: a pair that overlaps at all of them overlaps at
more than four fifths of all poses (95 % confidence)."""
_MOST_STATES = 20
"""Largest number of named states that are evaluated."""
_NEVER = "never"
Pair = frozenset[str]


@dataclass
class IgnoredPairs:
    """Pairs of links whose collisions a planner ignores.

    Attributes:
        pairs: pair -> its first ``disable_collisions``.
        enabled: pairs of ``enable_collisions``.
        alone: links of ``disable_default_collisions``, all of whose pairs are disabled.
    """

    pairs: dict[Pair, Node] = field(default_factory=dict)
    enabled: set[Pair] = field(default_factory=set)
    alone: set[str] = field(default_factory=set)

    def __contains__(self, pair: Pair) -> bool:
        """Whether collisions of the pair are disabled."""
        return pair in self.pairs or (bool(pair & self.alone) and pair not in self.enabled)


def check(srdf: Srdf) -> Iterator[Finding]:
    """Yield findings of the elements that name pairs of links."""
    shaped = {shape.body for shape in srdf.asset.shapes if shape.role == "collision"}
    first: dict[Pair, Node] = {}
    for node in srdf.root.all("disable_collisions"):
        yield from _ends(srdf, node)
        pair = _pair(node)
        if len(pair) == 1 and pair <= srdf.links:
            yield _pointless(node, "planning.pair_of_one", "both links are the same", "two links")
        elif pair in first:
            yield _pointless(
                node, "planning.pair_twice", f"line {first[pair].line} disables the pair", None
            )
        elif pair <= srdf.links and not pair <= shaped:
            bare = " and ".join(f"'{name}'" for name in sorted(pair - shaped))
            yield _pointless(
                node, "planning.pair_without_shape", f"without a collision shape: {bare}", None
            )
        first.setdefault(pair, node)
    for node in srdf.root.all("enable_collisions"):
        yield from _ends(srdf, node)
    for node in srdf.root.all("disable_default_collisions"):
        yield from srdf.unknown(node, "link", "link")
    for node in srdf.root.all("link_sphere_approximation"):
        yield from srdf.unknown(node, "link", "link")
        for sphere in node.all("sphere"):
            for attribute in ("center", "radius"):
                if attribute not in sphere.attributes:
                    yield missing_attribute(sphere, attribute, "center in m and radius in m")


def _ends(srdf: Srdf, node: Node) -> Iterator[Finding]:
    for attribute in ("link1", "link2"):
        yield from srdf.unknown(node, attribute, "link")


def _pair(node: Node) -> Pair:
    return frozenset(node.attributes.get(end, "") for end in ("link1", "link2"))


def _pointless(node: Node, code: str, title: str, expected: str | None) -> Finding:
    return Finding(
        code,
        "info",
        place_of(node),
        label_of(node),
        title,
        None,
        None,
        expected,
        "the element has no effect",
        "remove it",
    )


def ignored_pairs(srdf: Srdf) -> IgnoredPairs:
    """Return the pairs that a planner ignores."""
    found = IgnoredPairs()
    for node in srdf.root.all("disable_collisions"):
        found.pairs.setdefault(_pair(node), node)
    found.enabled = {_pair(node) for node in srdf.root.all("enable_collisions")}
    found.alone = {
        node.attributes.get("link", "") for node in srdf.root.all("disable_default_collisions")
    }
    return found


def measure_distances(srdf: Srdf, geometry: Geometry) -> tuple[list[PoseResult], list[Finding]]:
    """Compute distances at the base pose and every state, and findings of overlapping pairs."""
    if not any(shape.role == "collision" for shape in srdf.asset.shapes):
        return [], []
    skipped = ignored_pairs(srdf)
    hulls = self_collision.Hulls(srdf.asset, geometry)
    base = self_collision.base_pose(srdf.asset)
    at_base = hulls.near(BASE_POSE, base, joined=True)
    sampled = [
        hulls.near(f"sample {k + 1}", values, joined=True)
        for k, values in enumerate(_samples(srdf))
    ]
    always = set.intersection(*({_pair_of(n) for n in r.overlaps} for r in (at_base, *sampled)))
    findings = [*_always(srdf, at_base, always, skipped), *_never(srdf, (at_base, *sampled))]
    results = [at_base]
    for name, values in list(states.poses(srdf).items())[:_MOST_STATES]:
        pose = self_collision.with_followers(srdf.asset, base | values)
        result = hulls.near(name, pose, joined=True)
        results.append(result)
        findings += _state(srdf, result, always, skipped)
    return results, findings


def _pair_of(near: self_collision.NearPair) -> Pair:
    return frozenset((near.first, near.second))


def _samples(srdf: Srdf) -> list[dict[str, float]]:
    """Return poses distributed uniformly within the ranges, equal in every run; rad and m."""
    ranges = {}
    for joint in srdf.asset.joints:
        if not joint.is_scalar:
            continue
        if joint.is_limited and joint.lower is not None and joint.upper is not None:
            ranges[joint.name] = joint.lower, joint.upper
        else:
            ranges[joint.name] = (-math.pi, math.pi) if joint.kind == "hinge" else (0.0, 0.0)
    if not ranges:
        return []
    units = qmc.Halton(len(ranges), scramble=True, seed=0).random(_SAMPLES)
    return [
        self_collision.with_followers(
            srdf.asset,
            {
                name: low + float(unit) * (high - low)
                for (name, (low, high)), unit in zip(ranges.items(), row, strict=True)
            },
        )
        for row in units
    ]


def _always(
    srdf: Srdf, base: PoseResult, always: set[Pair], skipped: IgnoredPairs
) -> Iterator[Finding]:
    neighbours = {frozenset((edge.parent, edge.child)) for edge in srdf.asset.edges}
    for near in base.overlaps:
        pair = _pair_of(near)
        if pair not in always or pair in skipped:
            continue
        adjacent = pair in neighbours
        reason = "Adjacent" if adjacent else "Default"
        yield finding_of(
            "planning.always_collides",
            place_of(srdf.root),
            f"links '{near.first}' and '{near.second}'",
            near.distance,
            title=f"their convex hulls overlap at {_SAMPLES + 1} of {_SAMPLES + 1} poses, "
            "and the pair is not disabled",
            expected=f'<disable_collisions link1="{near.first}" link2="{near.second}" '
            f'reason="{reason}"/>',
            settle="disable the pair"
            + ("" if adjacent else ", or shrink the shapes if they should not touch"),
        )


def _never(srdf: Srdf, results: tuple[PoseResult, ...]) -> Iterator[Finding]:
    """Yield findings of pairs that overlap although their reason says that they never do."""
    disabled = ignored_pairs(srdf).pairs
    told: set[Pair] = set()
    for result in results:
        for near in result.overlaps:
            node = disabled.get(_pair_of(near))
            reason = "" if node is None else node.attributes.get("reason", "")
            if node is None or reason.strip().lower() != _NEVER or _pair_of(near) in told:
                continue
            told.add(_pair_of(near))
            yield finding_of(
                "planning.never_is_wrong",
                place_of(node),
                label_of(node),
                near.distance,
                title=f"the pair is disabled with the reason '{reason}', "
                "but its convex hulls overlap " + _where(srdf, near, result),
            )


def _where(srdf: Srdf, near: self_collision.NearPair, result: PoseResult) -> str:
    """Describe the positions of the joints between two links."""
    above = [srdf.carriers(link) for link in (near.first, near.second)]
    between = set(above[0]) ^ set(above[1])
    joints = [joint for joint in srdf.asset.joints if joint.body in between]
    said = [
        f"{joint.name} {result.values.get(joint.name, 0.0):.3g} {joint.unit}" for joint in joints
    ]
    return "at " + ", ".join(said) if said else "at every pose"


def _state(
    srdf: Srdf, result: PoseResult, always: set[Pair], skipped: IgnoredPairs
) -> Iterator[Finding]:
    node = next(
        node
        for node in srdf.root.all("group_state")
        if f"{node.attributes.get('group', '')}/{node.attributes.get('name', '')}" == result.name
    )
    for near in result.overlaps:
        pair = _pair_of(near)
        if pair in skipped or pair in always:
            continue
        yield finding_of(
            "planning.state_collides",
            place_of(node),
            label_of(node),
            near.distance,
            title=f"the convex hulls of '{near.first}' and '{near.second}' overlap there",
        )
