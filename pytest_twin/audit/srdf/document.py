"""Resolve the names of an SRDF in its URDF: members of groups, and existing names."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

from pytest_twin.audit.asset import Asset, Mimic
from pytest_twin.audit.finding import Finding, Place, finding_of
from pytest_twin.realization.node import Node

Kind = Literal["link", "joint", "group"]
_WHY: dict[Kind, str] = {
    "link": "MoveIt drops the element, and Pinocchio ignores it",
    "joint": "MoveIt drops the element, so the group or state lacks this joint",
    "group": "MoveIt drops the element",
}
MOST_GROUPS = 2000
"""Largest number of groups in a file: a humanoid has 30, and subgroups are resolved for each."""
_MOST_OFFERED, _MOST_COMPARED = 200, 2000
"""Suggestions are made for at most so many unknown names, each compared with at most so many known
names."""
_FREE_FLYER = "root_joint"
"""Pinocchio's name for the joint of a floating base; its SRDFs use it without a declaration."""


def place_of(node: Node) -> Place:
    """File and line of an element."""
    return Place(node.path, node.line)


def label_of(node: Node) -> str:
    """Describe an element: ``group 'arm'``, ``disable_collisions 'a', 'b'``."""
    if node.tag == "disable_collisions":
        ends = (node.attributes.get("link1", ""), node.attributes.get("link2", ""))
        return "{} '{}', '{}'".format(node.tag, *ends)
    return node.label


@dataclass
class Srdf:
    """An SRDF and its robot.

    Attributes:
        root: its ``robot`` element.
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
        """Return joint of the URDF that follows another -> its mimic."""
        return {mimic.follower: mimic for mimic in self.asset.mimics}

    @cached_property
    def passive(self) -> frozenset[str]:
        """Return the joints that the SRDF declares passive."""
        nodes = self.root.all("passive_joint")
        return frozenset(node.attributes.get("name", "") for node in nodes)

    @cached_property
    def groups(self) -> dict[str, Node]:
        """Name -> the first ``group`` of this name."""
        return _first_of_each(self.root.all("group"))

    def carriers(self, link: str) -> list[str]:
        """Return the link and its parents, up to the root."""
        found = [link]
        while (edge := self.asset.above.get(found[-1])) is not None and edge.parent not in found:
            found.append(edge.parent)
        return found

    def chain(self, base: str, tip: str) -> list[str] | None:
        """Return links from ``tip`` up to ``base``, both included; None if not connected."""
        found = self.carriers(tip)
        return found[: found.index(base) + 1] if base in found else None

    @cached_property
    def members(self) -> dict[str, tuple[frozenset[str], frozenset[str]]]:
        """Return group -> its joints and links, subgroups included."""
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
        """Return the group and all its existing subgroups, each once."""
        found, waiting = {name: None}, [name]
        while waiting:
            for child in self.groups[waiting.pop()].all("group"):
                part = child.attributes.get("name", "")
                if part in self.groups and part not in found:
                    found[part] = None
                    waiting.append(part)
        return list(found)

    def _own(self, group: Node) -> tuple[set[str], set[str]]:
        """Return joints and links of a group without its subgroups.

        A link adds its parent joint, and a joint adds its child link.
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
        """Return all names of links, joints or groups."""
        return {"link": self.links, "joint": self.joints, "group": self.groups}[kind]

    def _nearest(self, name: str, kind: Kind) -> str | None:
        """Return the most similar known name; None if there is none or the limit is reached."""
        if (name, kind) not in self._offered and len(self._offered) < _MOST_OFFERED:
            names = sorted(self.known(kind))[:_MOST_COMPARED]
            near = difflib.get_close_matches(name, names, n=1)
            self._offered[name, kind] = near[0] if near else None
        return self._offered.get((name, kind))

    def unknown(self, node: Node, attribute: str, kind: Kind) -> Iterator[Finding]:
        """Yield a finding if an attribute is missing, or names no existing link, joint or group."""
        name = node.attributes.get(attribute, "")
        if not name.strip():
            yield missing_attribute(node, attribute, f"the name of a {kind}")
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


def missing_attribute(node: Node, attribute: str, expected: str) -> Finding:
    """Build the finding for a missing or empty attribute."""
    return finding_of(
        "planning.missing_attribute",
        place_of(node),
        label_of(node),
        title=f"the attribute '{attribute}' is missing",
        expected=expected,
        settle=f"state {attribute}=...",
    )


def _first_of_each(nodes: list[Node]) -> dict[str, Node]:
    found: dict[str, Node] = {}
    for node in nodes:
        name = node.attributes.get("name", "")
        if name.strip():
            found.setdefault(name, node)
    return found
