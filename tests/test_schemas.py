"""Schemas of specs and results: every field that a reader may meet is described."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import resources
from typing import Any

import pytest

from pytest_twin.formats.schema import load_schema

FOLDER = resources.files("pytest_twin") / "schemas"
SCHEMAS = sorted(
    f"{place}{file.name}"
    for place, folder in (("", FOLDER), ("results/", FOLDER / "results"))
    for file in folder.iterdir()
    if file.name.endswith(".json")
)


def properties(schema: Any, place: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Dotted place and schema of each property, however deep."""
    if isinstance(schema, list):
        for one in schema:
            yield from properties(one, place)
    if not isinstance(schema, dict):
        return
    for name, one in schema.get("properties", {}).items():
        yield f"{place}.{name}", one
    for keyword, inner in schema.items():
        if keyword in ("properties", "patternProperties", "$defs"):
            for name, one in inner.items():
                yield from properties(one, f"{place}.{name}")
        elif keyword not in ("const", "enum", "default", "examples"):
            yield from properties(inner, place)


@pytest.mark.parametrize("name", SCHEMAS)
def test_every_property_of_a_schema_is_described(name: str) -> None:
    found = list(properties(load_schema(name)))
    assert len(found) > 3
    assert [place for place, one in found if not one.get("description", "").strip()] == []


@pytest.mark.parametrize(
    "around",
    [
        lambda leaf: {"properties": {"a": leaf}},
        lambda leaf: {"items": leaf},
        lambda leaf: {"prefixItems": [leaf]},
        lambda leaf: {"anyOf": [{"type": "null"}, leaf]},
        lambda leaf: {"additionalProperties": leaf},
        lambda leaf: {"patternProperties": {"^a": leaf}},
        lambda leaf: {"$defs": {"a": leaf}},
        lambda leaf: {"if": {"type": "object"}, "then": leaf},
    ],
    ids=["properties", "items", "prefixItems", "anyOf", "additional", "pattern", "defs", "then"],
)
def test_a_property_is_found_wherever_it_is_nested(around: Any) -> None:
    leaf = {"properties": {"length": {"type": "number"}}}
    places = [place for place, _ in properties(around(around(leaf)))]
    assert any(place.endswith(".length") for place in places)
