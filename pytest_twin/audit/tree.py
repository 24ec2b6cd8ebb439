"""Check the tree of links: one base, no loop, one parent for each link, unique names."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Finding, Place, finding_of
from pytest_twin.words import list_names


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
            yield finding_of(
                "tree.duplicate_name",
                place,
                f"{kind} '{name}'",
                name,
                title=f"a second {kind} with this name",
                expected=f"another name than in line {before.line}",
            )
            continue
        alike = folded.setdefault((kind, name.casefold()), name)
        if alike != name:
            yield finding_of(
                "tree.alike_names",
                place,
                f"{kind} '{name}'",
                name,
                title=f"its name differs from '{alike}' only in upper and lower case",
            )


def _ends(asset: Asset) -> Iterator[Finding]:
    for edge in asset.edges:
        for end, name in (("parent", edge.parent), ("child", edge.child)):
            if name not in asset.body:
                yield finding_of(
                    "tree.missing_link",
                    edge.place,
                    f"joint '{edge.name}'",
                    name,
                    title=f"its {end} link does not exist",
                )


def _parents(asset: Asset) -> Iterator[Finding]:
    for edge in asset.edges:
        above = asset.above[edge.child]
        if edge.parent == edge.child:
            yield finding_of(
                "tree.loop",
                edge.place,
                f"joint '{edge.name}'",
                edge.child,
                title="it joins a link to itself",
                expected="two different links",
                settle="look up in the drawing which link carries which",
            )
        elif edge is not above:
            yield finding_of(
                "tree.two_parents",
                edge.place,
                f"joint '{edge.name}'",
                edge.child,
                title=f"link '{edge.child}' already has a parent, by joint '{above.name}' "
                f"(line {above.place.line})",
            )


def _roots(asset: Asset) -> Iterator[Finding]:
    reached = set(asset.drawn)
    lost = [body for body in asset.body.values() if body.name not in reached]
    if lost:
        names = list_names([f"'{body.name}'" for body in lost])
        yield finding_of(
            "tree.loop",
            lost[0].place,
            f"link '{lost[0].name}'",
            float(len(lost)),
            title=f"links form a loop that no base carries: {names}",
            unit="links",
            expected="a chain of joints from the base to every link",
            settle="join one of these links to the base",
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
            yield finding_of(
                "tree.disconnected",
                asset.body[root].place,
                f"link '{root}'",
                float(sizes[root]),
                severity="critical" if asset.kind == "urdf" else "warning",
                title=f"no chain of joints connects it to the base '{base}'",
            )
