"""Parts of a JSON Schema: the fields of a spec, each on a line or two.

Each function returns a plain mapping. ``description`` is shown by editors and in errors; further
arguments are keywords of JSON Schema, such as ``minimum=0``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

Schema: TypeAlias = Mapping[str, Any]

NO_FIELDS: Schema = {"type": "object", "additionalProperties": False}
"""A table without fields."""


def table(
    properties: Mapping[str, Schema],
    description: str = "",
    *,
    required: Sequence[str] = (),
    **keywords: Any,
) -> Schema:
    """Fields of these names and no others."""
    if required:
        keywords["required"] = list(required)
    fixed = {"type": "object", "properties": dict(properties), "additionalProperties": False}
    return _schema(fixed, description, keywords)


def mapping(values: Schema, description: str = "", **keywords: Any) -> Schema:
    """Fields of any name, such as joints, each with a value of this schema."""
    return _schema({"type": "object", "additionalProperties": values}, description, keywords)


def array(
    items: Schema, description: str = "", *, count: int | None = None, **keywords: Any
) -> Schema:
    """List of values of this schema; exactly ``count`` of them where it is given."""
    size = {} if count is None else {"minItems": count, "maxItems": count}
    return _schema({"type": "array", "items": items, **size}, description, keywords)


def choice(values: Iterable[Any], description: str = "") -> Schema:
    """One of these values."""
    return _schema({"enum": list(values)}, description, {})


def any_of(*branches: Schema, description: str = "") -> Schema:
    """A value of at least one of these schemas."""
    return _schema({"anyOf": list(branches)}, description, {})


def text(description: str = "", **keywords: Any) -> Schema:
    """Text."""
    return _schema({"type": "string"}, description, keywords)


def name_field(description: str = "", **keywords: Any) -> Schema:
    """A name, or a path."""
    return text(description, minLength=1, maxLength=1000, **keywords)


def number(description: str = "", **keywords: Any) -> Schema:
    """A number."""
    return _schema({"type": "number"}, description, keywords)


def integer(description: str = "", **keywords: Any) -> Schema:
    """A whole number."""
    return _schema({"type": "integer"}, description, keywords)


def boolean(description: str = "") -> Schema:
    """True or false."""
    return _schema({"type": "boolean"}, description, {})


def quantity_field(
    description: str = (
        "A number in SI units, or a string with a unit such as '90 deg' or '5 mm'."
    ),
) -> Schema:
    """A number in SI units, or text with a unit."""
    return any_of(number(), text(), description=description)


def _schema(fixed: Mapping[str, Any], description: str, keywords: Mapping[str, Any]) -> Schema:
    return {**fixed, **({"description": description} if description else {}), **keywords}
