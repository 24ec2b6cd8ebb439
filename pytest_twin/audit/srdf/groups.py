"""Check groups, chains, end effectors, virtual and passive joints of an SRDF."""

from __future__ import annotations

from collections.abc import Iterator

from pytest_twin.audit.finding import Finding, finding_of
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
        yield finding_of(
            "planning.robot_name",
            place_of(srdf.root),
            f"robot '{name}'",
            name,
            title=f"{srdf.asset.path.name} describes another robot",
            expected=srdf.asset.name,
            settle=f"use the SRDF of this robot, or state name='{srdf.asset.name}'",
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
                yield finding_of(
                    "planning.same_name",
                    place_of(node),
                    label_of(node),
                    key[-1],
                    title=f"line {first[key].line} has a {tag} of the same name",
                    expected=f"one {tag} of this name",
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
        yield finding_of("planning.empty_group", place_of(group), label_of(group))


def _circular_group(srdf: Srdf, group: Node, part: Node) -> Iterator[Finding]:
    name, inner = group.attributes.get("name", ""), part.attributes.get("name", "")
    if inner in srdf.groups and name in srdf.with_subgroups(inner):
        yield finding_of(
            "planning.circular_group",
            place_of(part),
            label_of(group),
            inner,
            expected=f"groups that do not hold '{name}'",
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
    yield finding_of(
        "planning.chain",
        place_of(chain),
        f"{label_of(group)}: chain",
        f"{base} to {tip}",
        severity="critical" if severity == "critical" else "warning",
        title=title,
        settle=settle,
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
        yield finding_of(
            "planning.end_effector_parent",
            place_of(node),
            label_of(node),
            title=found[0],
            expected=found[1],
        )


def _virtual_joint(srdf: Srdf, node: Node) -> Iterator[Finding]:
    yield from srdf.unknown(node, "child_link", "link")
    child = node.attributes.get("child_link", "")
    if child in srdf.links and child not in srdf.asset.roots:
        yield finding_of(
            "planning.virtual_joint_child",
            place_of(node),
            label_of(node),
            child,
            expected=" or ".join(f"'{root}'" for root in srdf.asset.roots) or "the root link",
        )
    if not node.attributes.get("parent_frame", "").strip():
        yield missing_attribute(
            node, "parent_frame", "the frame in which the robot is placed, such as 'world'"
        )
    elif node.attributes["parent_frame"] in srdf.links and srdf.links:
        yield finding_of(
            "planning.virtual_joint_parent",
            place_of(node),
            label_of(node),
            node.attributes["parent_frame"],
        )
    kind = node.attributes.get("type", "")
    if kind not in _VIRTUAL_TYPES:
        yield finding_of(
            "planning.virtual_joint_type",
            place_of(node),
            label_of(node),
            kind or None,
            title="no type of a virtual joint" if kind else "its type is missing",
            expected=", ".join(_VIRTUAL_TYPES),
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
    yield finding_of(
        "planning.passive_joint",
        place_of(node),
        label_of(node),
        name,
        title=found[0],
        expected=found[1],
        settle=found[2],
    )
