"""The tree: one base, every body reached once, no loop, no name twice."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Finding, Place

_WHY_TREE = (
    "a tree is all that the format can say: parsers refuse the file, or each keeps another part"
)


def check(asset: Asset) -> Iterator[Finding]:
    """What is wrong with the tree of bodies."""
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
                f"a second {kind} of this name",
                name,
                None,
                f"a name unlike that in line {before.line}",
                "what refers to it by name reaches one of the two, and tools choose differently",
                "the supplier's drawing or source macro: which element each of the two is",
            )
            continue
        alike = folded.setdefault((kind, name.casefold()), name)
        if alike != name:
            yield Finding(
                "tree.alike_names",
                "warning",
                place,
                f"{kind} '{name}'",
                f"only case tells it from '{alike}'",
                name,
                None,
                "names that differ by more than case",
                "file systems and some formats take the two for one",
                "renaming one of them in the source",
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
                    f"its {end} is no link of this robot",
                    name,
                    None,
                    "the name of a link",
                    _WHY_TREE,
                    "the source macro: a misspelt name, or a link that was left out",
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
                "it ties a link to itself",
                edge.child,
                None,
                "two links",
                _WHY_TREE,
                "the drawing: which link carries which",
            )
        elif edge is not above:
            yield Finding(
                "tree.two_parents",
                "critical",
                edge.place,
                f"joint '{edge.name}'",
                f"link '{edge.child}' already hangs on joint '{above.name}' "
                f"(line {above.place.line})",
                edge.child,
                None,
                "one parent for each link",
                "a closed chain: " + _WHY_TREE,
                "the drawing: where a loop is real, cut it and state the closure to the simulator",
            )


def _roots(asset: Asset) -> Iterator[Finding]:
    reached = set(asset.drawn)
    lost = [body for body in asset.body.values() if body.name not in reached]
    if lost:
        names = ", ".join(f"'{body.name}'" for body in lost[:8])
        names += f" and {len(lost) - 8} more" if len(lost) > 8 else ""
        yield Finding(
            "tree.loop",
            "critical",
            lost[0].place,
            f"link '{lost[0].name}'",
            f"links that carry each other in a circle, apart from any base: {names}",
            float(len(lost)),
            "links",
            "a way from the base to every link",
            _WHY_TREE,
            "the drawing: which of these links is nearest to the base",
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
                f"no joint ties it to the base '{base}'",
                float(sizes[root]),
                "links",
                "one base",
                _WHY_TREE,
                "the drawing: the joint that carries it, or its removal",
            )
