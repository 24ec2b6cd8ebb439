"""Compiled JSON schemas accept the same values as the library jsonschema."""

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
    # Without references, so that no schema refers to itself endlessly.
    shared=_SCHEMAS.filter(lambda s: "$ref" not in repr(s)),
    data=st.lists(_VALUES | _OBJECTS, min_size=5, max_size=20),
)
def test_random_compiled_schemas_agree_with_jsonschema(
    body: dict[str, Any], shared: Any, data: list[Any]
) -> None:
    whole = {**body, "$defs": {"x": shared}}
    fits = compile_schema(whole)
    assert fits is not None
    authority = jsonschema.Draft202012Validator(whole)
    for value in data:
        assert fits(value) == authority.is_valid(value), value


INSTANCES: list[Any] = [
    *(None, True, False, 0, 1, 2, 3, 1.0, 2.5, -1, "", "a", "b", "ab", "abcd"),
    *([], [1], [1, 1], [1, True], [1, 1.0], ["a"], ["a", 1], [1, "a"], ["a", "a"], [1, 2, "a"]),
    *({}, {"a": 1}, {"a": "x"}, {"b": 1}, {"a": 1, "b": 1}, {"a": True}, {"ab": "x"}),
    *({"a": 1, "b": 2, "c": 3}, {"a": {"a": 1}}, {"a": [1]}, [{"a": 1}, {"a": 1.0}]),
]
SCHEMAS: list[dict[str, Any]] = [
    *({"type": name} for name in ("object", "array", "string", "number", "integer", "boolean")),
    *({"type": "null"}, {"type": ["string", "null"]}, {"enum": ["a", "b"]}, {"enum": [1, "a"]}),
    *({"enum": [True]}, {"enum": [[1], {"a": 1}]}, {"const": 1}, {"const": True}, {"const": 1.0}),
    *({"const": [1, 1]}, {"const": {"a": 1}}, {"required": ["a", "b"]}),
    {"properties": {"a": {"type": "string"}}},
    {"properties": {"a": True}, "additionalProperties": False},
    {"properties": {"a": True}, "additionalProperties": {"const": 1}},
    {"patternProperties": {"^a": {"type": "string"}}, "additionalProperties": False},
    {"properties": {"a": {"type": "integer"}}, "patternProperties": {"a": {"minimum": 2}}},
    *({"propertyNames": {"maxLength": 1}}, {"minProperties": 1}, {"maxProperties": 1}),
    *({"dependentRequired": {"a": ["b"]}}, {"items": {"type": "number"}}, {"items": False}),
    {"prefixItems": [{"type": "number"}]},
    {"prefixItems": [{"type": "number"}], "items": {"type": "string"}},
    *({"minItems": 2}, {"maxItems": 1}, {"uniqueItems": True}, {"uniqueItems": False}),
    *({"minLength": 2}, {"maxLength": 1}, {"pattern": "b"}, {"pattern": "^a$"}),
    *({"minimum": 1}, {"maximum": 1}, {"exclusiveMinimum": 1}, {"exclusiveMaximum": 1}),
    *({"allOf": [{"minimum": 1}, {"maximum": 2}]}, {"anyOf": [{"const": 1}, {"type": "string"}]}),
    *({"oneOf": [{"minimum": 1}, {"maximum": 2}]}, {"not": {"type": "string"}}),
    {"if": {"type": "string"}, "then": {"minLength": 1}, "else": {"type": "number"}},
    *({"if": {"type": "string"}, "then": {"minLength": 1}}, {"then": False}, {"else": False}),
    {"if": {"type": "string"}, "else": False},
    {"allOf": [{"type": "object"}, {"required": ["a"]}, {"maxProperties": 2}]},
    {"$defs": {"x/y~z": {"const": 1}}, "$ref": "#/$defs/x~1y~0z"},
    {"title": "t", "description": "d", "format": "date", "default": 3, "examples": [1]},
]


@pytest.mark.parametrize("body", SCHEMAS, ids=str)
def test_every_keyword_agrees_with_jsonschema(body: dict[str, Any]) -> None:
    fits = compile_schema(body)
    assert fits is not None
    authority = jsonschema.Draft202012Validator(body)
    for value in INSTANCES:
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
def test_schemas_with_unsupported_keywords_are_not_compiled(keyword: str) -> None:
    value = "#" if keyword == "$dynamicRef" else False
    assert compile_schema({"properties": {"a": {keyword: value}}}) is None


def test_schemas_with_unsupported_keywords_are_validated_by_jsonschema() -> None:
    closed = {"properties": {"a": {}}, "unevaluatedProperties": False}
    schema.validate(yaml.loads("a: 1", Path("x")), closed, Path("x"))
    with pytest.raises(SpecError):
        schema.validate(yaml.loads("b: 1", Path("x")), closed, Path("x"))
