"""The part for all elements of a model's file, including those that no simulator compiles."""

from __future__ import annotations

from typing import Any

from pytest_twin.dependency import Part, canonical
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.realization.named_model import NamedModel
from pytest_twin.realization.node import Node

_COLOURS = frozenset({"material", "texture", "rgba"})
"""Elements and attributes that only change the look of a robot."""


def elements_part(realization: NamedModel) -> Part:
    """Return the part of a realization that changes with any element, but for colours.

    Comments, white space, the order of attributes and the lines of elements have no effect.
    """
    content = canonical(_content(realization.source.root))
    return Part(f"{realization.name}/elements", {"sha256": bytes_sha256(content)})


def _content(node: Node) -> list[Any]:
    """Tag, attributes, text and children of an element."""
    return [
        node.tag,
        {name: text for name, text in node.attributes.items() if name not in _COLOURS},
        node.text.strip(),
        [_content(child) for child in node.children if child.tag not in _COLOURS],
    ]
