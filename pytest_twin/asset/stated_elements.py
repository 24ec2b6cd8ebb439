"""Collect what a URDF states besides links and joints, using the table of elements."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pytest_twin.asset.urdf_elements import TEXT, Entry, by_path, known_paths
from pytest_twin.realization.node import Node

_PARTS = ("param", "command_interface", "state_interface")
"""Elements that are described by their owner: a parameter of joint 'elbow'."""


@dataclass(frozen=True, slots=True)
class StatedElement:
    """One element or attribute of a URDF.

    Attributes:
        label: ``joint/limit@jerk``.
        owner: the named element that it belongs to, ``joint 'elbow'``.
        value: value as written.
        entry: entry of the table, None if no format of the table defines it.
    """

    node: Node
    label: str
    owner: str
    value: str
    entry: Entry | None


def stated_elements(robot: Node) -> Iterator[StatedElement]:
    """Yield every element and attribute below ``robot``, in the order of the file.

    Children of an undefined element are omitted.
    """
    waiting: list[tuple[Node, str, str]] = [(robot, "", "robot")]
    while waiting:
        node, path, owner = waiting.pop()
        table = by_path()
        for name, value in node.attributes.items():
            label = f"{path}@{name}" if path else f"@{name}"
            yield StatedElement(node, label, owner, value, table.get((path, name)))
        text = table.get((path, TEXT))
        if text is not None and node.text:
            parameter = node.attributes.get("name") if node.tag == "param" else None
            value = node.text if parameter is None else f"{parameter} = {node.text}"
            yield StatedElement(node, path, owner, value, text)
        below: list[tuple[Node, str, str]] = []
        for child in node.children:
            at = f"{path}/{child.tag}" if path else child.tag
            named = child.attributes.get("name") or child.attributes.get("reference")
            if child.tag in _PARTS:
                named = None
            whose = f"{child.tag} '{named}'" if named else owner
            whole = table.get((f"{at}/**", None)) or table.get((at, None))
            if whole is None and at not in known_paths():
                whole = table.get((f"{path}/*", None))
                if whole is None:
                    yield StatedElement(child, at, whose, child.text, None)
                    continue
            if whole is not None:
                yield StatedElement(child, at, whose, child.text, whole)
                continue
            below.append((child, at, whose))
        waiting.extend(reversed(below))


def is_neutral(found: StatedElement) -> bool:
    """Whether its value has no effect, such as an offset of 0 or a reduction of 1."""
    if found.entry is None or found.entry.neutral is None:
        return False
    expected = found.entry.neutral
    value = found.value.strip().casefold()
    if expected in ("true", "false"):
        return {"1": "true", "0": "false", "yes": "true", "no": "false"}.get(value, value) == (
            expected
        )
    try:
        return float(value) == float(expected)
    except ValueError:
        return False


def rows(robot: Node) -> dict[str, dict[str, str]]:
    """Return row of the loss matrix -> label and owner -> values that no realization preserves."""
    found: dict[str, dict[str, str]] = {}
    for one in stated_elements(robot):
        if one.entry is None or one.entry.goes.row is None:
            continue
        row = found.setdefault(one.entry.goes.row, {})
        name = f"{one.owner}: {one.label}"
        row[name] = f"{row[name]}, {one.value}" if name in row else one.value
    return found
