"""Translate schema violations into messages about the fields of the file."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pytest_twin.errors import SpecError
from pytest_twin.formats.yaml import Document

if TYPE_CHECKING:
    from jsonschema.exceptions import ValidationError

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
_VALIDATORS: dict[int, tuple[Mapping[str, Any], Any]] = {}


def explain(document: Document, schema: Mapping[str, Any], path: Path) -> SpecError | None:
    """Return the violation to correct first, or None if the document is valid."""
    kept = _VALIDATORS.get(id(schema))
    if kept is None:
        from jsonschema import Draft202012Validator

        kept = _VALIDATORS[id(schema)] = (schema, Draft202012Validator(dict(schema)))
    errors = [_deepest(error) for error in kept[1].iter_errors(document.data)]
    if not errors:
        return None
    error = min(errors, key=lambda e: (_rank(e), _line(document, _field(e)) or 0))
    return _as_spec_error(error, document, path)


def _deepest(error: ValidationError) -> ValidationError:
    """Descend into anyOf and oneOf, along the branch that matched most of the document."""
    while error.context:
        branches: dict[Any, list[ValidationError]] = {}
        for inner in error.context:
            branches.setdefault(inner.schema_path[0], []).append(inner)

        def distance(branch: list[ValidationError]) -> tuple[int, int]:
            here = [e for e in branch if not e.path and e.validator in ("type", "const", "enum")]
            return (len(here), -max(len(e.absolute_path) for e in branch))

        nearest = min(branches.values(), key=distance)
        if all(not e.path and e.validator == "type" for e in error.context):
            return error
        error = max(nearest, key=lambda e: len(e.absolute_path))
    return error


def _rank(error: ValidationError) -> int:
    # A misspelt field explains a missing one; a wrong kind explains all errors that result.
    order = ("const", "enum", "additionalProperties", "propertyNames", "required")
    return order.index(error.validator) if error.validator in order[2:] else 0


def _field(error: ValidationError) -> str:
    return ".".join(str(part) for part in error.absolute_path)


def _line(document: Document, where: str) -> int | None:
    """Return the line of a field, or of the nearest enclosing field in the file."""
    while where:
        if where in document.lines:
            return document.lines[where]
        where = where.rpartition(".")[0]
    return document.lines.get("")


def _as_spec_error(error: ValidationError, document: Document, path: Path) -> SpecError:
    where = _field(error)
    value: Any = error.instance
    bound: Any = error.validator_value
    schema: Any = error.schema
    kind = str(error.validator)
    shown: object = value if isinstance(value, str | int | float | bool) else None
    expected: str | None = None
    if kind == "additionalProperties":
        known = list(schema.get("properties", {}))
        extra = [key for key in value if key not in known]
        name = extra[0] if extra else where
        where = f"{where}.{name}" if where else name
        problem, shown, expected = "is not a known field", None, _closest(name, known, most=40)
    elif kind == "required":
        missing = [name for name in bound if name not in value]
        problem, shown = f"field {missing[0]!r} is missing", None
        expected = _description(schema.get("properties", {}).get(missing[0]))
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
        problem, expected = "has none of the allowed forms", _description(schema)
        if expected is None:
            expected = (
                " or ".join(dict.fromkeys(filter(None, (_description(branch) for branch in bound))))
                or None
            )
    elif kind == "dependentRequired":
        problem, shown = error.message, None
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
