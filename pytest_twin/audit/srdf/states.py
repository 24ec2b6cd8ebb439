"""Check named poses of an SRDF against the ranges of the URDF's joints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from pytest_twin.audit.asset import Joint
from pytest_twin.audit.finding import Finding, finding_of
from pytest_twin.audit.srdf.document import Srdf, label_of, place_of
from pytest_twin.errors import ModelError
from pytest_twin.realization.node import Node

_ROUNDED = 1e-3
"""rad or m: an excess below this is attributed to rounding, for example to three decimals."""
_SAME = 1e-6
"""rad or m: usual precision of values in SRDFs."""
_MIMIC = 1e-3
"""Largest deviation of a mimic joint from its leader, rad or m. Setup tools write values with three
or four decimals."""
_DIGITS = 6
"""Number of significant digits in messages."""


def check(srdf: Srdf) -> Iterator[Finding]:
    """Findings of every ``group_state``."""
    for state in srdf.root.all("group_state"):
        yield from srdf.unknown(state, "group", "group")
        for node in state.all("joint"):
            yield from srdf.unknown(node, "name", "joint")
            yield from _value(srdf, state, node)
        yield from _members(srdf, state)
        yield from _followers(srdf, state)


def poses(srdf: Srdf) -> dict[str, dict[str, float]]:
    """``group/state`` -> joint -> rad or m, of joints with one readable value."""
    found: dict[str, dict[str, float]] = {}
    for state in srdf.root.all("group_state"):
        group, name = (state.attributes.get(key, "") for key in ("group", "name"))
        found.setdefault(f"{group}/{name}", _values(srdf, state))
    return found


def _values(srdf: Srdf, state: Node) -> dict[str, float]:
    values = {}
    for node in state.all("joint"):
        joint = srdf.asset.joint.get(node.attributes.get("name", ""))
        numbers = _numbers(node)
        if joint is not None and joint.is_scalar and numbers is not None and len(numbers) == 1:
            values[joint.name] = numbers[0]
    return values


def _numbers(node: Node) -> list[float] | None:
    try:
        return [float(value) for value in node.numbers("value", None, most=math.inf)]
    except ModelError:
        return None


def _value(srdf: Srdf, state: Node, node: Node) -> Iterator[Finding]:
    name = node.attributes.get("name", "")
    element = f"{label_of(state)}: joint '{name}'"
    joint = srdf.asset.joint.get(name)
    numbers = _numbers(node)
    count = None if joint is None else _variables(joint)
    if numbers is None or (count is not None and len(numbers) != count):
        unit = "" if joint is None or not joint.is_scalar else f" in {joint.unit}"
        yield finding_of(
            "planning.state_value",
            place_of(node),
            element,
            node.attributes.get("value"),
            expected=f"{count} finite numbers"
            if count not in (None, 1)
            else f"a finite number{unit}",
        )
        return
    if joint is None:
        if name in srdf.child_of:
            yield _pointless(node, element, "the joint is fixed", "a joint that moves")
        return
    if joint.is_scalar:
        yield from _range(joint, numbers[0], node, element)


def _variables(joint: Joint) -> int:
    """Return the number of values of a joint: MoveIt states orientations as quaternions."""
    return {"hinge": 1, "slide": 1, "ball": 4, "planar": 3, "free": 7}[joint.kind]


def _range(joint: Joint, value: float, node: Node, element: str) -> Iterator[Finding]:
    if not joint.is_limited or joint.is_continuous or joint.lower is None or joint.upper is None:
        return
    beyond = max(joint.lower - value, value - joint.upper)
    if beyond <= _SAME:
        return
    rounded = beyond <= _ROUNDED
    degrees = (
        joint.kind == "hinge"
        and abs(value) > math.tau
        and joint.lower <= math.radians(value) <= joint.upper
    )
    settle = "state a value within the range, or correct the limit in the URDF"
    if rounded:
        settle = "state the value with the digits of the limit"
    elif degrees:
        settle = f"if the value is in degrees, state {math.radians(value):.{_DIGITS}g} rad"
    yield finding_of(
        "planning.state_range",
        place_of(node),
        element,
        value,
        severity="warning" if rounded else "critical",
        title="the state lies beyond the joint's range" + (", by rounding" if rounded else ""),
        unit=joint.unit,
        expected=f"{joint.lower:.{_DIGITS}g} to {joint.upper:.{_DIGITS}g} {joint.unit}",
        settle=settle,
    )


def _pointless(node: Node, element: str, title: str, expected: str) -> Finding:
    return finding_of(
        "planning.state_joint",
        place_of(node),
        element,
        node.attributes.get("value"),
        title=title,
        expected=expected,
    )


def _members(srdf: Srdf, state: Node) -> Iterator[Finding]:
    """Yield findings of joints outside the state's group, and of group joints without a value."""
    group = state.attributes.get("group", "")
    if group not in srdf.groups:
        return
    members = srdf.members[group][0]
    stated = set()
    for node in state.all("joint"):
        name = node.attributes.get("name", "")
        stated.add(name)
        if name in srdf.joints and name not in members:
            element = f"{label_of(state)}: joint '{name}'"
            yield _pointless(
                node, element, f"the group '{group}' does not contain it", f"a joint of '{group}'"
            )
    moving = {name for name in members if name in srdf.asset.joint}
    left_out = sorted(moving - stated - srdf.mimic_of.keys() - srdf.passive)
    if left_out:
        yield finding_of(
            "planning.state_incomplete",
            place_of(state),
            label_of(state),
            ", ".join(left_out[:6]) + (" ..." if len(left_out) > 6 else ""),
            title=f"{len(left_out)} joints of the group '{group}' have no value",
        )


def _followers(srdf: Srdf, state: Node) -> Iterator[Finding]:
    """Yield findings of mimic joints whose value contradicts their leader."""
    values = _values(srdf, state)
    nodes: Mapping[str, Node] = {n.attributes.get("name", ""): n for n in state.all("joint")}
    for name in values:
        mimic = srdf.mimic_of.get(name)
        if mimic is None or mimic.leader not in values:
            continue
        follows = mimic.multiplier * values[mimic.leader] + mimic.offset
        if abs(values[mimic.follower] - follows) > _MIMIC:
            joint = srdf.asset.joint[mimic.follower]
            yield finding_of(
                "planning.state_mimic",
                place_of(nodes[mimic.follower]),
                f"{label_of(state)}: joint '{mimic.follower}'",
                values[mimic.follower],
                title=f"it follows '{mimic.leader}', which puts it elsewhere",
                unit=joint.unit,
                expected=f"{follows:.{_DIGITS}g} {joint.unit}",
            )
