"""The quick answer is the right one: compiled schemas agree with jsonschema."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_twin.errors import SpecError
from pytest_twin.formats import schema, yaml
from pytest_twin.formats.schema_compiler import compile_schema

NAMES = ["a", "b", "kind"]
_VALUES = st.recursive(
    st.none() | st.booleans() | st.sampled_from([0, 1, 2, 1.0, 2.5, -1, "a", "b", "ab", "", "fk"]),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(NAMES), inner, max_size=3)
    ),
    max_leaves=8,
)
_SMALL = st.integers(0, 3)


def _keywords(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    named = st.dictionaries(st.sampled_from(NAMES), inner, max_size=2)
    types = st.sampled_from(["object", "array", "string", "number", "integer", "boolean", "null"])
    options = {
        "type": types | st.lists(types, min_size=1, max_size=3, unique=True),
        "enum": st.lists(_VALUES, min_size=1, max_size=3) | st.just(["a", "b"]),
        "const": _VALUES,
        "required": st.lists(st.sampled_from(NAMES), max_size=2, unique=True),
        "properties": named,
        "patternProperties": st.dictionaries(st.sampled_from(["^a", "."]), inner, max_size=1),
        "additionalProperties": inner,
        "propertyNames": inner,
        "minProperties": _SMALL,
        "maxProperties": _SMALL,
        "dependentRequired": st.just({"a": ["b"]}),
        "items": inner,
        "prefixItems": st.lists(inner, min_size=1, max_size=2),
        "minItems": _SMALL,
        "maxItems": _SMALL,
        "uniqueItems": st.booleans(),
        "minLength": _SMALL,
        "maxLength": _SMALL,
        "pattern": st.sampled_from(["^a", "b$"]),
        "minimum": _SMALL,
        "maximum": _SMALL,
        "exclusiveMinimum": _SMALL,
        "exclusiveMaximum": _SMALL,
        "allOf": st.lists(inner, min_size=1, max_size=2),
        "anyOf": st.lists(inner, min_size=1, max_size=2),
        "oneOf": st.lists(inner, min_size=1, max_size=2),
        "not": inner,
        "if": inner,
        "then": inner,
        "else": inner,
        "$ref": st.just("#/$defs/x"),
    }
    return st.lists(st.sampled_from(sorted(options)), max_size=4, unique=True).flatmap(
        lambda names: st.fixed_dictionaries({name: options[name] for name in names})
    )


_SCHEMAS = st.recursive(st.booleans() | st.just({}), _keywords, max_leaves=6)
_OBJECTS = st.dictionaries(st.sampled_from(NAMES), _VALUES, max_size=3)


@settings(max_examples=150, deadline=None)
@given(
    body=_keywords(_SCHEMAS),
    # No reference in it, so that none refers to itself for ever.
    shared=_SCHEMAS.filter(lambda s: "$ref" not in repr(s)),
    data=st.lists(_VALUES | _OBJECTS, min_size=5, max_size=20),
)
def test_agrees_with_jsonschema(body: dict[str, Any], shared: Any, data: list[Any]) -> None:
    whole = {**body, "$defs": {"x": shared}}
    fits = compile_schema(whole)
    assert fits is not None
    authority = jsonschema.Draft202012Validator(whole)
    for value in data:
        assert fits(value) == authority.is_valid(value), value


def test_a_schema_may_refer_to_itself() -> None:
    tree = {
        "$ref": "#/$defs/node",
        "$defs": {
            "node": {
                "type": "object",
                "additionalProperties": {"$ref": "#/$defs/node"},
            }
        },
    }
    fits = compile_schema(tree)
    assert fits is not None
    assert fits({"a": {"b": {}}})
    assert not fits({"a": {"b": 1}})


@pytest.mark.parametrize("keyword", ["unevaluatedProperties", "contains", "$dynamicRef"])
def test_what_it_does_not_know_it_leaves_to_jsonschema(keyword: str) -> None:
    value = "#" if keyword == "$dynamicRef" else False
    assert compile_schema({"properties": {"a": {keyword: value}}}) is None


def test_an_unknown_keyword_still_refuses() -> None:
    closed = {"properties": {"a": {}}, "unevaluatedProperties": False}
    schema.validate(yaml.loads("a: 1", Path("x")), closed, Path("x"))
    with pytest.raises(SpecError):
        schema.validate(yaml.loads("b: 1", Path("x")), closed, Path("x"))
