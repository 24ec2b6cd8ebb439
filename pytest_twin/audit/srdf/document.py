"""An SRDF beside the URDF that it names: who is in which group, and which names exist."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

from pytest_twin.audit.asset import Asset, Mimic
from pytest_twin.audit.finding import Finding, Place
from pytest_twin.realization.node import Node

Kind = Literal["link", "joint", "group"]
_WHY: dict[Kind, str] = {
    "link": "MoveIt drops the element, and Pinocchio ignores it",
    "joint": "MoveIt drops the element, so the group or state lacks this joint",
    "group": "MoveIt drops the element",
}
MOST_GROUPS = 2000
"""Groups of one file: a humanoid has 30. Parts of groups are followed from each of them."""
_MOST_OFFERED, _MOST_COMPARED = 200, 2000
"""Unknown names for which a known one is looked for, and names that each is compared with."""
_FREE_FLYER = "root_joint"
"""What Pinocchio calls the joint of a floating base; its SRDFs name it without declaring it."""


def place_of(node: Node) -> Place:
    """File and line of an element."""
    return Place(node.path, node.line)


def label_of(node: Node) -> str:
    """An element as people name it: ``group 'arm'``, ``disable_collisions 'a', 'b'``."""
    if node.tag == "disable_collisions":
        ends = (node.attributes.get("link1", ""), node.attributes.get("link2", ""))
        return "{} '{}', '{}'".format(node.tag, *ends)
    return node.label


@dataclass
class Srdf:
    """An SRDF and its robot.

    Attributes:
        root: its ``robot`` element.
        asset: the URDF.
    """

    root: Node
    asset: Asset
    _offered: dict[tuple[str, Kind], str | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = sum(node.tag == "group" for node in self.root.walk())
        if count > MOST_GROUPS:
            raise self.root.limit("too many groups", value=count, expected=f"at most {MOST_GROUPS}")

    @cached_property
    def links(self) -> frozenset[str]:
        """Links of the URDF."""
        return frozenset(self.asset.body)

    @cached_property
    def child_of(self) -> dict[str, str]:
        """Joint of the URDF, fixed ones included -> its child link."""
        return {edge.name: edge.child for edge in self.asset.edges}

    @cached_property
    def virtual_joints(self) -> dict[str, Node]:
        """Name -> the first ``virtual_joint`` of this name."""
        return _first_of_each(self.root.all("virtual_joint"))

    @cached_property
    def joints(self) -> frozenset[str]:
        """Joints of the URDF, and virtual joints."""
        return frozenset(self.child_of) | frozenset(self.virtual_joints)

    @cached_property
    def mimic_of(self) -> dict[str, Mimic]:
        """Joint of the URDF that follows another -> how."""
        return {mimic.follower: mimic for mimic in self.asset.mimics}

    @cached_property
    def passive(self) -> frozenset[str]:
        """Joints that the SRDF calls passive."""
        nodes = self.root.all("passive_joint")
        return frozenset(node.attributes.get("name", "") for node in nodes)

    @cached_property
    def groups(self) -> dict[str, Node]:
        """Name -> the first ``group`` of this name."""
        return _first_of_each(self.root.all("group"))

    def carriers(self, link: str) -> list[str]:
        """The link and those that carry it, up to the root."""
        found = [link]
        while (edge := self.asset.above.get(found[-1])) is not None and edge.parent not in found:
            found.append(edge.parent)
        return found

    def chain(self, base: str, tip: str) -> list[str] | None:
        """Links from ``tip`` up to ``base``, both included; None where ``base`` is not above."""
        found = self.carriers(tip)
        return found[: found.index(base) + 1] if base in found else None

    @cached_property
    def members(self) -> dict[str, tuple[frozenset[str], frozenset[str]]]:
        """Group -> its joints and its links, those of its subgroups included."""
        own = {name: self._own(node) for name, node in self.groups.items()}
        found = {}
        for name in own:
            joints: set[str] = set()
            links: set[str] = set()
            for part in self.with_subgroups(name):
                joints |= own[part][0]
                links |= own[part][1]
            found[name] = frozenset(joints), frozenset(links)
        return found

    def with_subgroups(self, name: str) -> list[str]:
        """The group and all below it that exist, each once."""
        found, waiting = {name: None}, [name]
        while waiting:
            for child in self.groups[waiting.pop()].all("group"):
                part = child.attributes.get("name", "")
                if part in self.groups and part not in found:
                    found[part] = None
                    waiting.append(part)
        return list(found)

    def _own(self, group: Node) -> tuple[set[str], set[str]]:
        """Joints and links of a group without its subgroups.

        A link brings the joint that carries it, a joint its child link.
        """
        joints: set[str] = set()
        links: set[str] = set()
        for node in group.all("link"):
            links.add(node.attributes.get("name", ""))
        for node in group.all("joint"):
            joints.add(node.attributes.get("name", ""))
        for link in links:
            if link in self.asset.above:
                joints.add(self.asset.above[link].name)
        for node in group.all("chain"):
            ends = node.attributes.get("base_link", ""), node.attributes.get("tip_link", "")
            chain = self.chain(*ends) if set(ends) <= self.links else None
            links |= set(chain or ())
            joints |= {self.asset.above[link].name for link in (chain or ())[:-1]}
        links |= {self.child_of[joint] for joint in joints if joint in self.child_of}
        return joints & self.joints, links & self.links

    def known(self, kind: Kind) -> Collection[str]:
        """Names of links, of joints or of groups."""
        return {"link": self.links, "joint": self.joints, "group": self.groups}[kind]

    def _nearest(self, name: str, kind: Kind) -> str | None:
        """The known name that is most like another; None where none is, or many were asked for."""
        if (name, kind) not in self._offered and len(self._offered) < _MOST_OFFERED:
            names = sorted(self.known(kind))[:_MOST_COMPARED]
            near = difflib.get_close_matches(name, names, n=1)
            self._offered[name, kind] = near[0] if near else None
        return self._offered.get((name, kind))

    def unknown(self, node: Node, attribute: str, kind: Kind) -> Iterator[Finding]:
        """A finding where an attribute is missing, or names no link, joint or group."""
        name = node.attributes.get(attribute, "")
        if not name.strip():
            yield missing(node, attribute, f"the name of a {kind}")
            return
        names = self.known(kind)
        if name in names:
            return
        near = self._nearest(name, kind)
        free = kind == "joint" and name == _FREE_FLYER
        owner = "this SRDF" if kind == "group" else self.asset.path.name
        yield Finding(
            f"planning.unknown_{kind}",
            "warning" if free else "critical",
            place_of(node),
            f"{label_of(node)}: {attribute}",
            f"no {kind} of this name",
            name,
            None,
            f"a {kind} of {owner}" + (f", such as '{near}'" if near else ""),
            "Pinocchio names its free-flyer so; MoveIt drops the element" if free else _WHY[kind],
            f'declare <virtual_joint name="{name}" type="floating" .../>'
            if free
            else f"correct the name, or remove the element if {owner} lost the {kind}",
        )


def missing(node: Node, attribute: str, expected: str) -> Finding:
    """The finding that an attribute is missing or empty."""
    return Finding(
        "planning.missing_attribute",
        "critical",
        place_of(node),
        label_of(node),
        f"the attribute '{attribute}' is missing",
        None,
        None,
        expected,
        "MoveIt drops the element",
        f"state {attribute}=...",
    )


def _first_of_each(nodes: list[Node]) -> dict[str, Node]:
    found: dict[str, Node] = {}
    for node in nodes:
        name = node.attributes.get("name", "")
        if name.strip():
            found.setdefault(name, node)
    return found
