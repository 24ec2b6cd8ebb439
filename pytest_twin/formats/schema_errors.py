"""Translate schema violations into messages about the fields of the file."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from jsonschema_rs import ValidationError, ValidationErrorKind

from pytest_twin.errors import SpecError
from pytest_twin.formats.yaml import Document

_TYPE_WORDS = {
    "object": "a mapping of fields",
    "array": "a list",
    "string": "text",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "null": "nothing",
}
_BOUND_WORDS = {
    "minimum": "at least",
    "exclusiveMinimum": "more than",
    "maximum": "at most",
    "exclusiveMaximum": "less than",
}
_NO_BRANCH_FITS = (ValidationErrorKind.AnyOf, ValidationErrorKind.OneOfNotValid)


def explain(
    errors: list[ValidationError], document: Document, schema: Mapping[str, Any], path: Path
) -> SpecError:
    """Return the violation to correct first."""
    deepest = [_deepest(error) for error in errors]
    error = min(
        deepest,
        key=lambda e: (_rank(e), _line(document, _field(e)) or 0, -len(e.instance_path)),
    )
    return _as_spec_error(error, document, schema, path)


def _deepest(error: ValidationError) -> ValidationError:
    """Descend into anyOf and oneOf, along the branch that matched most of the document."""
    while isinstance(error.kind, _NO_BRANCH_FITS):
        depth = len(error.instance_path)
        branches = error.kind.context
        if all(
            len(e.instance_path) == depth and e.kind.name == "type" for b in branches for e in b
        ):
            return error
        nearest = min(branches, key=partial(_distance, depth=depth))
        error = max(nearest, key=lambda e: (len(e.instance_path), -_rank(e)))
    return error


def _distance(branch: list[ValidationError], depth: int) -> tuple[int, int]:
    """Order the branches of an object ``depth`` fields deep by how little of it they match."""
    of_object = [
        e
        for e in branch
        if len(e.instance_path) == depth and e.kind.name in ("type", "const", "enum")
    ]
    return (len(of_object), -max(len(e.instance_path) for e in branch))


def _rank(error: ValidationError) -> int:
    # A misspelt field explains a missing one; a wrong kind explains all errors that result.
    return {"additionalProperties": 1, "required": 2}.get(error.kind.name, 0)


def _keyword(error: ValidationError) -> str:
    # The library reports a violation of dependentRequired as one of "required".
    by_another = error.schema_path[-1:] == ["dependentRequired"]
    return "dependentRequired" if by_another else error.kind.name


def _schema_of(error: ValidationError, root: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the part of the schema that has the violated keyword."""
    schema: Any = root
    for part in error.schema_path[:-1]:
        schema = schema[part]
    return schema if isinstance(schema, Mapping) else {}


def _field(error: ValidationError) -> str:
    return ".".join(str(part) for part in error.instance_path)


def _line(document: Document, where: str) -> int | None:
    """Return the line of a field, or of the nearest enclosing field in the file."""
    while where:
        if where in document.lines:
            return document.lines[where]
        where = where.rpartition(".")[0]
    return document.lines.get("")


def _as_spec_error(
    error: ValidationError, document: Document, root: Mapping[str, Any], path: Path
) -> SpecError:
    where = _field(error)
    if isinstance(error.kind, ValidationErrorKind.PropertyNames):
        error = error.kind.error
    value: Any = error.instance
    kind = _keyword(error)
    schema = _schema_of(error, root)
    bound: Any = schema.get(kind)
    shown: object = value if isinstance(value, str | int | float | bool) else None
    expected: str | None = None
    if kind == "additionalProperties":
        known = list(schema.get("properties", {}))
        extra = [key for key in value if key not in known]
        name = extra[0] if extra else where
        where = f"{where}.{name}" if where else name
        problem, shown, expected = "is not a known field", None, _closest(name, known, most=40)
    elif isinstance(error.kind, ValidationErrorKind.Required):
        name, shown = error.kind.property, None
        problem = f"field {name!r} is missing"
        if kind != "required":
            problem += " beside " + next(repr(k) for k in value if name in bound.get(k, ()))
        expected = _description(schema.get("properties", {}).get(name))
    elif kind in ("enum", "const"):
        allowed = list(bound) if kind == "enum" else [bound]
        problem, shown = "is not one of the allowed values", _scalar_or_none(value)
        words = [str(item) for item in allowed]
        expected = _closest(value, words) if isinstance(value, str) else _join_words(words)
    elif kind == "type":
        names = [bound] if isinstance(bound, str) else list(bound)
        problem = f"is {_kind_of(value)}"
        expected = " or ".join(_TYPE_WORDS.get(name, name) for name in names)
        if "examples" in schema:
            expected = _description(schema) or expected
    elif kind in ("minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum"):
        small = "inimum" in kind
        problem = "is too small" if small else "is too large"
        expected = f"{_BOUND_WORDS[kind]} {bound}"
    elif kind in ("minItems", "maxItems", "minProperties", "maxProperties"):
        problem, shown = f"holds {len(value)}", None
        expected = f"at {'least' if kind.startswith('min') else 'most'} {bound}"
    elif kind in ("minLength", "maxLength"):
        problem = "is too short" if kind == "minLength" else "is too long"
        expected = f"at {'least' if kind == 'minLength' else 'most'} {bound} characters"
    elif kind == "pattern":
        problem = "has the wrong form"
        expected = _description(schema) or f"text like {bound}"
    elif kind == "uniqueItems":
        problem, shown, expected = "contains a value twice", None, "each value once"
    elif kind in ("anyOf", "oneOf"):
        several = isinstance(error.kind, ValidationErrorKind.OneOfMultipleValid)
        problem = f"has {'several' if several else 'none'} of the allowed forms"
        forms = dict.fromkeys(_description(branch) for branch in bound)
        expected = _description(schema) or " or ".join(filter(None, forms)) or None
    elif kind == "not":
        problem, expected = "is not allowed", _description(schema)
    else:
        problem = error.message
    return SpecError(
        problem,
        path=path,
        line=_line(document, where),
        where=where or None,
        value=shown,
        expected=expected,
    )


def _description(schema: object) -> str | None:
    if not isinstance(schema, Mapping):
        return None
    if isinstance(schema.get("description"), str):
        text: str = schema["description"]
        return text.rstrip(".")
    if "enum" in schema:
        return _join_words([str(item) for item in schema["enum"]])
    if "const" in schema:
        return str(schema["const"])
    kinds = schema.get("type")
    if kinds is None:
        return None
    return " or ".join(
        _TYPE_WORDS.get(name, name) for name in ([kinds] if isinstance(kinds, str) else kinds)
    )


def _closest(name: str, known: list[str], most: int = 12) -> str:
    if not known:
        return "no fields here"
    near = difflib.get_close_matches(name[:100], known, n=1)
    return _join_words(known, most) + (f"; did you mean {near[0]!r}?" if near else "")


def _join_words(words: list[str], most: int = 12) -> str:
    if len(words) == 1:
        return words[0]
    shown = ", ".join(words[:most])
    return f"one of {shown}" + (f" and {len(words) - most} more" if len(words) > most else "")


def _scalar_or_none(value: object) -> object:
    return value if isinstance(value, str | int | float) else None


def _kind_of(value: object) -> str:
    for name, test in (
        ("boolean", bool),
        ("number", (int, float)),
        ("string", str),
        ("array", list),
        ("object", dict),
    ):
        if isinstance(value, test):
            return _TYPE_WORDS[name]
    return "empty"
