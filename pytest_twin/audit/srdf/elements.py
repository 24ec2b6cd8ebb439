"""Find elements of an SRDF that MoveIt ignores: misspelt, or of another tool."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from functools import cache

from pytest_twin.asset.urdf_elements import by_path
from pytest_twin.audit.finding import Finding, finding_of
from pytest_twin.audit.srdf.document import Srdf, place_of
from pytest_twin.realization.node import Node

ELEMENTS = (
    "group",
    "group_state",
    "end_effector",
    "virtual_joint",
    "passive_joint",
    "joint_property",
    "disable_collisions",
    "enable_collisions",
    "disable_default_collisions",
    "link_sphere_approximation",
)
"""Elements at the top of an SRDF."""
_WITHIN = ("link", "joint", "group", "chain", "sphere")
"""Elements within them."""
_ROTORS = "rotor_params"
_OTHER_TOOLS = {
    "gripper": "Humanoid Path Planner",
    "handle": "Humanoid Path Planner",
    "contact": "Humanoid Path Planner",
    "specificities": "Pinocchio's humanoid tools",
}


def check(srdf: Srdf) -> Iterator[Finding]:
    """One finding for each element or attribute that SRDF does not define."""
    for node in srdf.root.children:
        if node.tag == _ROTORS:
            yield _rotors(node)
            yield from (
                f for joint in node.all("joint") for f in srdf.unknown(joint, "name", "joint")
            )
        elif node.tag not in ELEMENTS:
            yield _unknown(node, node.tag)
        else:
            yield from _attributes(node, node.tag)
            for child in node.children:
                at = f"{node.tag}/{child.tag}"
                if child.tag not in _WITHIN or not _attributes_of(at):
                    yield _unknown(child, at, _WITHIN)
                else:
                    yield from _attributes(child, at)


@cache
def _attributes_of(at: str) -> tuple[str, ...]:
    """Return the attributes that SRDF defines for an element path; empty if undefined."""
    return tuple(attribute for path, attribute in by_path() if path == at and attribute)


def _attributes(node: Node, at: str) -> Iterator[Finding]:
    known = _attributes_of(at)
    for name in node.attributes:
        if name not in known:
            yield _unknown(node, f"{at}@{name}", known)


def _unknown(node: Node, label: str, known: Sequence[str] = ELEMENTS) -> Finding:
    what = "attribute" if "@" in label else "element"
    name = label.rpartition("@" if what == "attribute" else "/")[2]
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.8)
    tool = _OTHER_TOOLS.get(name) if what == "element" else None
    return finding_of(
        "planning.custom_tag",
        place_of(node),
        label,
        name,
        severity="warning" if near else "info",
        title=f"SRDF has no such {what}" + (f"; {tool} reads it" if tool else ""),
        expected=near[0] if near else None,
        why=f"MoveIt and Pinocchio ignore the {what}",
        settle=f"write {near[0]}" if near else "keep it if a tool of yours reads it",
    )


def _rotors(node: Node) -> Finding:
    joints = node.all("joint")
    values = [
        f"{joint.attributes.get('name')}: mass={joint.attributes.get('mass')} "
        f"gear_ratio={joint.attributes.get('gear_ratio')}"
        for joint in joints[:2]
    ]
    return finding_of(
        "planning.rotor_inertia",
        place_of(node),
        f"{_ROTORS} of {len(joints)} joints",
        "; ".join(values) + (" ..." if len(joints) > len(values) else ""),
    )
