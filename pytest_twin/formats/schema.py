"""Validate documents against a JSON Schema; an error has the field, its line and the expectation.

Validation must not slow down the collection of a thousand specs: ``jsonschema-rs`` validates one in
a few microseconds, and each schema is compiled once.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pytest_twin.errors import SpecError
from pytest_twin.formats.yaml import Document

if TYPE_CHECKING:
    from jsonschema_rs import Draft202012Validator

# Keyed by id(schema); storing the schema keeps that id from being reused.
_COMPILED: dict[int, tuple[Mapping[str, Any], Draft202012Validator]] = {}


def validate(document: Document, schema: Mapping[str, Any], path: Path) -> None:
    """Validate ``document`` against a JSON Schema (Draft 2020-12).

    ``schema`` is compiled once per object: pass the same mapping each time and do not change it.

    Raises:
        SpecError: the document is invalid; the error has line, dotted field, value and expectation.
        SpecError: ``schema``, of a check that another package brings, is no JSON Schema.
    """
    compiled = _COMPILED.get(id(schema))
    if compiled is None:
        import jsonschema_rs

        try:
            # offline: a schema may not make us read files or ask a server.
            validator = jsonschema_rs.Draft202012Validator(dict(schema), offline=True)
        except (ValueError, jsonschema_rs.ReferencingError) as error:
            raise SpecError(
                "the check of this kind has no valid schema",
                path=path,
                value=str(error)[:300],
                expected="a JSON Schema (Draft 2020-12) as attribute `schema` of the check",
            ) from error
        compiled = _COMPILED[id(schema)] = (schema, validator)
    validator = compiled[1]
    if not validator.is_valid(document.data):
        from pytest_twin.formats.schema_errors import explain

        raise explain(list(validator.iter_errors(document.data)), document, schema, path)


@cache
def load_schema(name: str) -> Mapping[str, Any]:
    """Load a JSON Schema of the package, such as ``golden.schema.json``.

    Raises:
        SpecError: the package has no such schema.
    """
    folder = resources.files("pytest_twin") / "schemas"
    file = folder / name
    try:
        found: Mapping[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        there = sorted(p.name for p in folder.iterdir() if p.name.endswith(".json"))
        raise SpecError(
            "the package has no such schema",
            value=name,
            expected="one of " + ", ".join(there),
        ) from None
    return found
