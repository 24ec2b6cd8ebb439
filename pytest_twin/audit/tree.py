"""Check the tree of links: one base, no loop, one parent for each link, unique names."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Finding, Place
from pytest_twin.words import list_names

_WHY_TREE = "URDF describes a tree: parsers refuse the file, or each keeps a different part of it"


def check(asset: Asset) -> Iterator[Finding]:
    """Faults of the tree of links."""
    yield from _duplicates(asset)
    yield from _ends(asset)
    yield from _parents(asset)
    yield from _roots(asset)


def _duplicates(asset: Asset) -> Iterator[Finding]:
    first: dict[tuple[str, str], Place] = {}
    folded: dict[tuple[str, str], str] = {}
    for kind, name, place in asset.named:
        before = first.setdefault((kind, name), place)
        if before is not place:
            yield Finding(
                "tree.duplicate_name",
                "critical",
                place,
                f"{kind} '{name}'",
                f"a second {kind} with this name",
                name,
                None,
                f"another name than in line {before.line}",
                "references by name reach one of the two, and tools choose differently",
                "rename one of them, and check what refers to the name",
            )
            continue
        alike = folded.setdefault((kind, name.casefold()), name)
        if alike != name:
            yield Finding(
                "tree.alike_names",
                "warning",
                place,
                f"{kind} '{name}'",
                f"its name differs from '{alike}' only in upper and lower case",
                name,
                None,
                "names that differ in more than upper and lower case",
                "some file systems and formats treat the two as one name",
                "rename one of them",
            )


def _ends(asset: Asset) -> Iterator[Finding]:
    for edge in asset.edges:
        for end, name in (("parent", edge.parent), ("child", edge.child)):
            if name not in asset.body:
                yield Finding(
                    "tree.missing_link",
                    "critical",
                    edge.place,
                    f"joint '{edge.name}'",
                    f"its {end} link does not exist",
                    name,
                    None,
                    "the name of a link of this robot",
                    _WHY_TREE,
                    "correct the name, or add the link",
                )


def _parents(asset: Asset) -> Iterator[Finding]:
    for edge in asset.edges:
        above = asset.above[edge.child]
        if edge.parent == edge.child:
            yield Finding(
                "tree.loop",
                "critical",
                edge.place,
                f"joint '{edge.name}'",
                "it joins a link to itself",
                edge.child,
                None,
                "two different links",
                _WHY_TREE,
                "look up in the drawing which link carries which",
            )
        elif edge is not above:
            yield Finding(
                "tree.two_parents",
                "critical",
                edge.place,
                f"joint '{edge.name}'",
                f"link '{edge.child}' already has a parent, by joint '{above.name}' "
                f"(line {above.place.line})",
                edge.child,
                None,
                "one parent joint for each link",
                _WHY_TREE,
                "cut a real loop at one joint, and close it in the simulator's model",
            )


def _roots(asset: Asset) -> Iterator[Finding]:
    reached = set(asset.drawn)
    lost = [body for body in asset.body.values() if body.name not in reached]
    if lost:
        names = list_names([f"'{body.name}'" for body in lost])
        yield Finding(
            "tree.loop",
            "critical",
            lost[0].place,
            f"link '{lost[0].name}'",
            f"links form a loop that no base carries: {names}",
            float(len(lost)),
            "links",
            "a chain of joints from the base to every link",
            _WHY_TREE,
            "join one of these links to the base",
        )
    if len(asset.roots) < 2:
        return
    sizes = dict.fromkeys(asset.roots, 1)
    owner = {root: root for root in asset.roots}
    for edge in asset.in_order():
        owner[edge.child] = owner[edge.parent]
        sizes[owner[edge.child]] += 1
    base = max(asset.roots, key=lambda root: sizes[root])
    for root in asset.roots:
        if root != base:
            yield Finding(
                "tree.disconnected",
                # A stage may hold other things than the robot.
                "critical" if asset.kind == "urdf" else "warning",
                asset.body[root].place,
                f"link '{root}'",
                f"no chain of joints connects it to the base '{base}'",
                float(sizes[root]),
                "links",
                "one base link",
                _WHY_TREE,
                "add the joint that carries it, or remove it",
            )
