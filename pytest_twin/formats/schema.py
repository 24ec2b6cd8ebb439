"""Validate documents against a JSON Schema; an error has the field, its line and the expectation.

Validation must not slow down the collection of a thousand specs. Schemas are therefore compiled
once into plain functions that return True or False. ``jsonschema`` runs only if the result is
False, or if the compiler does not support a keyword; it finds the invalid field.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from pytest_twin.errors import SpecError
from pytest_twin.formats.schema_compiler import compile_schema
from pytest_twin.formats.schema_errors import explain
from pytest_twin.formats.yaml import Document

# Keyed by id(schema); storing the schema keeps that id from being reused.
_COMPILED: dict[int, tuple[Mapping[str, Any], Any]] = {}


def validate(document: Document, schema: Mapping[str, Any], path: Path) -> None:
    """Validate ``document`` against a JSON Schema (Draft 2020-12).

    ``schema`` is compiled once per object: pass the same mapping each time and do not change it.

    Raises:
        SpecError: the document is invalid; the error has line, dotted field, value and expectation.
    """
    kept = _COMPILED.get(id(schema))
    if kept is None:
        kept = _COMPILED[id(schema)] = (schema, compile_schema(schema))
    fits = kept[1]
    if fits is not None and fits(document.data):
        return
    error = explain(document, schema, path)
    if error is not None:
        raise error


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
