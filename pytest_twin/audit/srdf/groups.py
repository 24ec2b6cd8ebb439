"""Check groups, chains, end effectors, virtual and passive joints of an SRDF."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.finding import Finding
from pytest_twin.audit.srdf.document import Srdf, label_of, missing_attribute, place_of
from pytest_twin.realization.node import Node

_VIRTUAL_TYPES = ("fixed", "floating", "planar")


def check(srdf: Srdf) -> Iterator[Finding]:
    """Yield findings of all elements that name links, joints or groups, except states and pairs."""
    yield from _robot_name(srdf)
    yield from _twice(srdf)
    for group in srdf.root.all("group"):
        yield from _group(srdf, group)
    for node in srdf.root.all("end_effector"):
        yield from _end_effector(srdf, node)
    for node in srdf.root.all("virtual_joint"):
        yield from _virtual_joint(srdf, node)
    for node in srdf.root.all("passive_joint"):
        yield from _passive_joint(srdf, node)
    for node in srdf.root.all("joint_property"):
        yield from srdf.unknown(node, "joint_name", "joint")
        for attribute in ("property_name", "value"):
            if not node.attributes.get(attribute, "").strip():
                yield missing_attribute(node, attribute, "a property and its value")


def _robot_name(srdf: Srdf) -> Iterator[Finding]:
    name = srdf.root.attributes.get("name", "")
    if name != srdf.asset.name:
        yield Finding(
            "planning.robot_name",
            "warning",
            place_of(srdf.root),
            f"robot '{name}'",
            f"{srdf.asset.path.name} describes another robot",
            name,
            None,
            srdf.asset.name,
            "MoveIt reports an error, and an SRDF of another robot variant may be in use",
            f"use the SRDF of this robot, or state name='{srdf.asset.name}'",
        )


def _twice(srdf: Srdf) -> Iterator[Finding]:
    """Yield findings of names shared by two elements of one kind."""
    for tag in ("group", "end_effector", "virtual_joint", "group_state"):
        first: dict[tuple[str, ...], Node] = {}
        for node in srdf.root.all(tag):
            keys = ("group", "name") if tag == "group_state" else ("name",)
            key = tuple(node.attributes.get(word, "") for word in keys)
            if not key[-1].strip():
                yield missing_attribute(node, "name", "a name")
            elif key in first:
                yield Finding(
                    "planning.same_name",
                    "warning",
                    place_of(node),
                    label_of(node),
                    f"line {first[key].line} has a {tag} of the same name",
                    key[-1],
                    None,
                    f"one {tag} of this name",
                    "MoveIt keeps one of them",
                    "rename or remove one",
                )
            else:
                first[key] = node


def _group(srdf: Srdf, group: Node) -> Iterator[Finding]:
    members = 0
    for node in group.all("link"):
        members += 1
        yield from srdf.unknown(node, "name", "link")
    for node in group.all("joint"):
        members += 1
        yield from srdf.unknown(node, "name", "joint")
    for node in group.all("group"):
        members += 1
        yield from srdf.unknown(node, "name", "group")
        yield from _circular_group(srdf, group, node)
    for node in group.all("chain"):
        members += 1
        yield from _chain(srdf, group, node)
    if not members:
        yield Finding(
            "planning.empty_group",
            "warning",
            place_of(group),
            label_of(group),
            "it has no member",
            None,
            None,
            "links, joints, chains or other groups",
            "MoveIt does not make the group",
            "list its members, or remove it",
        )


def _circular_group(srdf: Srdf, group: Node, part: Node) -> Iterator[Finding]:
    name, inner = group.attributes.get("name", ""), part.attributes.get("name", "")
    if inner in srdf.groups and name in srdf.with_subgroups(inner):
        yield Finding(
            "planning.circular_group",
            "critical",
            place_of(part),
            label_of(group),
            "it is a part of itself",
            inner,
            None,
            f"groups that do not hold '{name}'",
            "MoveIt makes none of the groups of the loop",
            "remove the group from its own parts",
        )


def _chain(srdf: Srdf, group: Node, chain: Node) -> Iterator[Finding]:
    wrong = [
        finding
        for attribute in ("base_link", "tip_link")
        for finding in srdf.unknown(chain, attribute, "link")
    ]
    yield from wrong
    base, tip = (chain.attributes.get(end, "") for end in ("base_link", "tip_link"))
    if wrong or (base != tip and srdf.chain(base, tip) is not None):
        return
    if base == tip:
        title, severity = "it starts and ends at the same link", "critical"
        settle = "state the link at its other end"
    elif srdf.chain(tip, base) is not None:
        title, severity = "it runs towards the base: base_link lies beyond tip_link", "warning"
        settle = "exchange base_link and tip_link"
    else:
        title, severity = "base_link does not carry tip_link", "warning"
        settle = "choose a base_link on the way from the root to tip_link"
    yield Finding(
        "planning.chain",
        "critical" if severity == "critical" else "warning",
        place_of(chain),
        f"{label_of(group)}: chain",
        title,
        f"{base} to {tip}",
        None,
        "a base_link from which the tree leads to tip_link",
        "kinematics solvers take a chain from its base outwards",
        settle,
    )


def _end_effector(srdf: Srdf, node: Node) -> Iterator[Finding]:
    yield from srdf.unknown(node, "parent_link", "link")
    yield from srdf.unknown(node, "group", "group")
    link, own = (node.attributes.get(key, "") for key in ("parent_link", "group"))
    parent = node.attributes.get("parent_group", "")
    if parent:
        yield from srdf.unknown(node, "parent_group", "group")
    found = None
    if parent and parent == own:
        found = f"its group '{own}' is its parent_group too", "the group of the arm"
    elif parent in srdf.groups and link in srdf.links and link not in srdf.members[parent][1]:
        found = (
            f"its parent_group '{parent}' does not contain its parent_link '{link}'",
            f"a group with '{link}', or a link of '{parent}'",
        )
    elif own in srdf.groups and link in srdf.members[own][1]:
        found = (
            f"its parent_link '{link}' belongs to its own group '{own}'",
            "the link of the arm to which the end effector is mounted",
        )
    if found is not None:
        yield Finding(
            "planning.end_effector_parent",
            "warning",
            place_of(node),
            label_of(node),
            found[0],
            None,
            None,
            found[1],
            "MoveIt does not know which arm carries the end effector",
            "correct parent_link or parent_group",
        )


def _virtual_joint(srdf: Srdf, node: Node) -> Iterator[Finding]:
    yield from srdf.unknown(node, "child_link", "link")
    child = node.attributes.get("child_link", "")
    if child in srdf.links and child not in srdf.asset.roots:
        yield Finding(
            "planning.virtual_joint_child",
            "warning",
            place_of(node),
            label_of(node),
            "its child_link is not the root of the robot",
            child,
            None,
            " or ".join(f"'{root}'" for root in srdf.asset.roots) or "the root link",
            "MoveIt ignores a virtual joint that does not carry the root link",
            "state the root link as child_link",
        )
    if not node.attributes.get("parent_frame", "").strip():
        yield missing_attribute(
            node, "parent_frame", "the frame in which the robot is placed, such as 'world'"
        )
    elif node.attributes["parent_frame"] in srdf.links and srdf.links:
        yield Finding(
            "planning.virtual_joint_parent",
            "warning",
            place_of(node),
            label_of(node),
            "its parent_frame is a link of the robot itself",
            node.attributes["parent_frame"],
            None,
            "a frame outside the robot, such as 'world'",
            "the frame then has two parents",
            "name a frame that no link has",
        )
    kind = node.attributes.get("type", "")
    if kind not in _VIRTUAL_TYPES:
        yield Finding(
            "planning.virtual_joint_type",
            "critical",
            place_of(node),
            label_of(node),
            "no type of a virtual joint" if kind else "its type is missing",
            kind or None,
            None,
            ", ".join(_VIRTUAL_TYPES),
            "MoveIt takes it as fixed",
            "state the type",
        )


def _passive_joint(srdf: Srdf, node: Node) -> Iterator[Finding]:
    yield from srdf.unknown(node, "name", "joint")
    name = node.attributes.get("name", "")
    driven = [item.place for item in srdf.asset.transmissions if name in item.joints]
    driven += [item.place for item in srdf.asset.controlled if item.joint == name and item.commands]
    if name in srdf.child_of and name not in srdf.asset.joint:
        found = "the joint is fixed", "a joint that moves", "remove the element"
    elif driven:
        found = (
            f"line {driven[0].line} of {driven[0].path.name} drives it",
            "a joint without a motor",
            "remove the element, or the transmission or command interface",
        )
    else:
        return
    yield Finding(
        "planning.passive_joint",
        "warning",
        place_of(node),
        label_of(node),
        found[0],
        name,
        None,
        found[1],
        "MoveIt expects no command for a passive joint",
        found[2],
    )
