"""JSON Schema of golden specs, combined from the schemas of all kinds."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pytest_twin.checks import Check, check_of, kinds
from pytest_twin.formats import atomic

SCHEMA_VERSION = 1
SHIPPED = "schemas/golden.schema.json"
# SI unit -> example of a tolerance.
_EXAMPLES = {
    **{"m": "0.5 mm", "rad": "5 mrad", "s": "2 ms", "kg": "5 g", "1": "2 %"},
    **{"N": "0.1 N", "N*m": "5 mN*m", "J": "1 mJ", "Hz": "0.2 Hz", "dB": "0.5 dB"},
    **{"m/s": "2 mm/s", "rad/s": "1 deg/s"},
}
_SHA256 = {"type": "string", "pattern": "^[0-9a-f]{64}$"}
_TEXT = {"type": "string", "minLength": 1, "maxLength": 1000}

_COMMON: Mapping[str, Any] = {
    "schema": {"const": SCHEMA_VERSION, "description": "Version of this schema."},
    "kind": {**_TEXT, "description": "The check that runs this golden."},
    "title": {**_TEXT, "description": "One line for people."},
    "realizations": {
        "description": "Names from twin.yaml that it runs on; the twin's first one by default.",
        "type": "array",
        "items": _TEXT,
        "minItems": 1,
        "uniqueItems": True,
    },
    "criticality": {
        "description": "critical blocks a release, advisory is reported.",
        "enum": ["critical", "advisory"],
    },
    "target": {"type": "object", "description": "The tested joints, frames or bodies."},
    "stimulus": {"type": "object", "description": "Poses, motions or commands of the test."},
    "tolerance": {
        "description": "Bound on each error, a number and a unit, such as '0.5 mm'.",
        "type": "object",
        "additionalProperties": _TEXT,
    },
    "expected": {
        "type": "object",
        "description": "Recorded values; written by pytest --twin-update.",
    },
    "trace": {
        "description": "Recorded series next to the spec; written by pytest --twin-update.",
        "type": "object",
        "properties": {
            "file": {"type": "string", "pattern": r"^[^/\\]+\.csv$"},
            "sha256": _SHA256,
        },
        "required": ["file", "sha256"],
        "additionalProperties": False,
    },
    "provenance": {
        "description": "Who recorded it, when and on what; written by pytest --twin-update.",
        "type": "object",
        "properties": {
            "recorded_by": _TEXT,
            "recorded_at": {
                "type": "string",
                "pattern": r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z$",
            },
            "realization": _TEXT,
            "simulator": _TEXT,
            "parts": {"type": "object", "additionalProperties": _SHA256},
        },
        "required": ["recorded_by", "recorded_at", "realization", "simulator", "parts"],
        "additionalProperties": False,
    },
}
_REQUIRED = ("schema", "kind")


def modeline(schema: str) -> str:
    """Comment that tells editors the path of the schema, relative to the spec."""
    return f"# yaml-language-server: $schema={schema}"


@cache
def schema_of(kind: str) -> Mapping[str, Any]:
    """Schema of a complete spec of one kind.

    Raises:
        SpecError: no such kind is installed.
    """
    check = check_of(kind)
    fragment = _fragment(check)
    return {
        "type": "object",
        "properties": {**_COMMON, **fragment["properties"]},
        "required": [*_REQUIRED, *fragment["required"]],
        "additionalProperties": False,
        "$defs": dict(check.schema.get("$defs", {})),
    }


def golden_schema(kinds: Iterable[str]) -> dict[str, Any]:
    """Schema of all specs of ``kinds`` in one document, for editors."""
    branches = []
    definitions: dict[str, Any] = {}
    for kind in sorted(kinds):
        check = check_of(kind)
        definitions.update(check.schema.get("$defs", {}))
        branches.append(
            {
                "if": {"properties": {"kind": {"const": kind}}, "required": ["kind"]},
                "then": _fragment(check),
            }
        )
    kind_property = {**_COMMON["kind"], "examples": sorted(kinds)}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "pytest-twin golden spec",
        "type": "object",
        "properties": {**_COMMON, "kind": kind_property},
        "required": list(_REQUIRED),
        "additionalProperties": False,
        "allOf": branches,
        "$defs": definitions,
    }


def _fragment(check: Check) -> dict[str, Any]:
    """Schema of what a kind declares: target, stimulus, names and units of tolerances."""
    properties: dict[str, Any] = {
        name: check.schema[name] for name in ("target", "stimulus") if name in check.schema
    }
    properties["tolerance"] = {
        "type": "object",
        "properties": {name: _quantity(unit) for name, unit in sorted(check.tolerances.items())},
        "required": sorted(check.required_tolerances),
        "additionalProperties": False,
    }
    required = ["tolerance"] if check.required_tolerances else []
    required += [
        name for name in ("target", "stimulus") if properties.get(name, {}).get("required")
    ]
    return {"properties": properties, "required": required}


def _quantity(unit: str) -> dict[str, Any]:
    """Schema of a tolerance in ``unit``; a check of another package may use any unit."""
    example = _EXAMPLES.get(unit, f"1 {unit}")
    return {
        **_TEXT,
        "description": f"a number with its unit, such as {example!r}",
        "examples": [example],
    }


def _write_shipped_schema() -> None:
    """Write the schema file of the package, with the kinds of pytest-twin itself."""
    ours = [kind for kind in kinds() if type(check_of(kind)).__module__.startswith("pytest_twin.")]
    path = Path(__file__).parent.parent / SHIPPED
    atomic.write_text(path, json.dumps(golden_schema(ours), indent=1) + "\n")


if __name__ == "__main__":
    _write_shipped_schema()
