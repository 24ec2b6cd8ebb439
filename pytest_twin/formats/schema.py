"""Documents compared with a JSON Schema; the error says which field, where, and what was expected.

Collecting a thousand specs must not wait for a validator: schemas are compiled once into plain
functions that say yes or no, and only a no (or a keyword that the compiler does not know) asks
``jsonschema``, which then names the field at fault.
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

# Keyed by identity; the schema is kept so that its identity stays its own.
_COMPILED: dict[int, tuple[Mapping[str, Any], Any]] = {}


def validate(document: Document, schema: Mapping[str, Any], path: Path) -> None:
    """Hold ``document`` against a JSON Schema (Draft 2020-12).

    ``schema`` is compiled once per object: pass the same mapping each time and do not change it.

    Raises:
        SpecError: the document does not fit, with line, dotted field, value and what was expected.
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
    """A JSON Schema that ships with the package, such as ``golden.schema.json``.

    Raises:
        SpecError: no such schema ships.
    """
    folder = resources.files("pytest_twin") / "schemas"
    file = folder / name
    try:
        found: Mapping[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        there = sorted(p.name for p in folder.iterdir() if p.name.endswith(".json"))
        raise SpecError(
            "no such schema ships with the package",
            value=name,
            expected="one of " + ", ".join(there),
        ) from None
    return found
