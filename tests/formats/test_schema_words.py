"""Schema errors state field, line and expected value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pytest_twin.errors import SpecError
from pytest_twin.formats import schema, yaml

SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["kind"],
    "additionalProperties": False,
    "properties": {
        "schema": {"const": 1},
        "kind": {"enum": ["fk", "step", "settling"]},
        "title": {"type": "string", "minLength": 1, "maxLength": 10},
        "count": {"type": "integer", "minimum": 1, "exclusiveMaximum": 10},
        "names": {"type": "array", "items": {"type": "string"}, "minItems": 1, "uniqueItems": True},
        "tolerance": {
            "type": "object",
            "properties": {
                "position": {"type": "string", "pattern": "m$", "description": "a length."}
            },
            "additionalProperties": False,
        },
        "where": {
            "anyOf": [
                {"type": "string"},
                {
                    "type": "object",
                    "required": ["frame"],
                    "properties": {"frame": {"type": "string"}},
                },
            ]
        },
    },
}
PATH = Path("g.yaml")


@pytest.mark.parametrize(
    ("text", "line", "where", "words"),
    [
        ("a: 1", 1, "a", "a: is not a known field (expected one of schema, kind,"),
        ("kind: fk\nkinds: 1", 2, "kinds", "is not a known field"),
        ("kind: fk\ntolerance:\n  positon: 1 m", 3, "tolerance.positon", "expected position"),
        ("\ntitle: x", 2, None, "field 'kind' is missing (expected one of fk, step, settling)"),
        ("kind: stepp", 1, "kind", "got 'stepp'; expected one of fk, step, settling; did you mean"),
        ("kind: fk\nschema: 2", 2, "schema", "(got 2; expected 1)"),
        ("kind: fk\ntitle: 3", 2, "title", "is a number (got 3; expected text)"),
        ("kind: fk\ntitle: ''", 2, "title", "is too short (got ''; expected at least 1 characters"),
        ("kind: fk\ncount: 0", 2, "count", "is too small (got 0; expected at least 1)"),
        ("kind: fk\ncount: 10", 2, "count", "is too large (got 10; expected less than 10)"),
        ("kind: fk\ncount: true", 2, "count", "is true or false (got True; expected a whole"),
        ("kind: fk\nnames: []", 2, "names", "holds 0 (expected at least 1)"),
        ("kind: fk\nnames: [a, a]", 2, "names", "contains a value twice"),
        ("kind: fk\nnames:\n  - a\n  - 2", 4, "names.1", "is a number (got 2; expected text)"),
        ("kind: fk\nnames: {a: 1}", 2, "names", "is a mapping of fields (expected a list)"),
        (
            "kind: fk\ntolerance: {position: 3}",
            2,
            "tolerance.position",
            "is a number (got 3; expected text)",
        ),
        (
            "kind: fk\ntolerance:\n\n  position: 3 kg",
            4,
            "tolerance.position",
            "has the wrong form (got '3 kg'; expected a length)",
        ),
        (
            "kind: fk\nwhere: 3",
            2,
            "where",
            "has none of the allowed forms (got 3; expected text",
        ),
        ("kind: fk\nwhere: {frame: 1}", 2, "where.frame", "is a number (got 1; expected text)"),
        ("[]", 1, None, "is a list (expected a mapping of fields)"),
        ("~", 1, None, "is empty (expected a mapping of fields)"),
    ],
)
def test_a_schema_error_states_field_line_and_expected_value(
    text: str, line: int, where: str | None, words: str
) -> None:
    with pytest.raises(SpecError) as caught:
        schema.validate(yaml.loads(text, PATH), SCHEMA, PATH)
    assert words in str(caught.value)
    assert (caught.value.line, caught.value.where) == (line, where)
    assert caught.value.path == PATH


def test_a_misspelt_field_is_reported_instead_of_a_missing_field() -> None:
    with pytest.raises(SpecError, match=r"kimd: is not a known field.*did you mean 'kind'"):
        schema.validate(yaml.loads("kimd: fk", PATH), SCHEMA, PATH)


def test_a_valid_document_passes() -> None:
    text = "kind: fk\ncount: 9\nnames: [a, b]\ntolerance: {position: 3 mm}\nwhere: {frame: tcp}\n"
    schema.validate(yaml.loads(text, PATH), SCHEMA, PATH)


def test_shipped_schemas_are_cached() -> None:
    assert schema.load_schema("twin.schema.json") is schema.load_schema("twin.schema.json")


@pytest.mark.parametrize(
    "broken", [{"type": "txt"}, {"$ref": "#/$defs/none"}, {"$ref": "https://example.org/a.json"}]
)
def test_a_schema_that_is_not_valid_is_reported(broken: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match="the check of this kind has no valid schema"):
        schema.validate(yaml.loads("a: 1", PATH), broken, PATH)


def test_a_line_feed_at_the_end_does_not_pass_a_pattern_without_control_characters() -> None:
    text = {"properties": {"name": {"type": "string", "pattern": "^[^\u0000-\u001f]+$"}}}
    with pytest.raises(SpecError, match="name: has the wrong form"):
        schema.validate(yaml.loads('name: "arm\\n"', PATH), text, PATH)


@pytest.mark.parametrize(
    ("part", "text", "words"),
    [
        ({"propertyNames": {"pattern": "^[a-z]+$"}}, "a: {B: 1}", "a: has the wrong form (got 'B'"),
        ({"dependentRequired": {"x": ["y"]}}, "a: {x: 1}", "a: field 'y' is missing beside 'x'"),
        ({"not": {"const": 0}, "description": "A ratio."}, "a: 0", "a: is not allowed (got 0; "),
        ({"if": {"type": "object"}, "then": {"required": ["z"]}}, "a: {}", "field 'z' is missing"),
        ({"oneOf": [{"minimum": 1}, {"maximum": 2}]}, "a: 1", "a: has several of the allowed"),
        ({"$ref": "#/$defs/x"}, "a: 1", "a: is a number (got 1; expected text)"),
    ],
)
def test_every_keyword_has_words(part: dict[str, Any], text: str, words: str) -> None:
    whole = {"properties": {"a": part}, "$defs": {"x": {"type": "string"}}}
    with pytest.raises(SpecError) as caught:
        schema.validate(yaml.loads(text, PATH), whole, PATH)
    assert words in str(caught.value)


def test_an_unknown_schema_is_an_error() -> None:
    with pytest.raises(SpecError, match="the package has no such schema"):
        schema.load_schema("nothing.schema.json")
