"""JSON Schema of golden specs, combined from the schemas of all kinds."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pytest_twin.checks import Check, check_of, kinds
from pytest_twin.checks.fields import tolerance_schema
from pytest_twin.checks.schemas import array, choice, mapping, name_field, table, text
from pytest_twin.formats import atomic

SCHEMA_VERSION = 1
"""Version of the layout of golden specs."""
SHIPPED = "schemas/golden.schema.json"
_SHA256 = {"type": "string", "pattern": "^[0-9a-f]{64}$"}

_COMMON: Mapping[str, Any] = {
    "schema": {"const": SCHEMA_VERSION, "description": "Version of this schema."},
    "kind": name_field("Kind of golden: the check that runs it."),
    "title": name_field("One line for readers."),
    "realizations": array(
        name_field(),
        "Names of realizations in twin.yaml. Default: the first one.",
        minItems=1,
        uniqueItems=True,
    ),
    "criticality": choice(
        ["critical", "advisory"],
        "critical (default): a failure blocks a release. advisory: a failure is only reported.",
    ),
    "target": {"type": "object", "description": "The tested joints, frames or bodies."},
    "stimulus": {"type": "object", "description": "Poses, motions or commands of the test."},
    "tolerance": mapping(
        name_field(),
        "Largest allowed error of each quantity: a number and a unit, such as '0.5 mm'.",
    ),
    "expected": {
        "type": "object",
        "description": "Recorded values; written by pytest --twin-update.",
    },
    "trace": table(
        {
            "file": text("CSV file in the folder of the spec.", pattern="^[^/\\\\]+\\.csv$"),
            "sha256": {**_SHA256, "description": "SHA-256 of the file, hex."},
        },
        "Recorded series in a file next to the spec; written by pytest --twin-update.",
        required=["file", "sha256"],
    ),
    "provenance": table(
        {
            "recorded_by": name_field("Person or service that recorded it."),
            "recorded_at": text(
                "UTC time, such as 2026-01-31T12:00:00Z.",
                pattern="^\\d{4}-\\d\\d-\\d\\dT\\d\\d:\\d\\d:\\d\\d(\\.\\d+)?Z$",
            ),
            "realization": name_field("Realization that it was recorded with."),
            "simulator": name_field("Simulator and its version."),
            "parts": mapping(
                _SHA256, "What the golden depends on, such as mujoco/inertia -> SHA-256, hex."
            ),
        },
        "By whom, when and with what it was recorded; written by pytest --twin-update.",
        required=["recorded_by", "recorded_at", "realization", "simulator", "parts"],
    ),
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
                "if": {
                    "properties": {"kind": {"const": kind, **_description_of("kind")}},
                    "required": ["kind"],
                },
                "then": _fragment(check),
            }
        )
    kind_property = {**_COMMON["kind"], "examples": sorted(kinds)}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:pytest-twin:golden:{SCHEMA_VERSION}",
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
        name: {**_description_of(name), **check.schema[name]}
        for name in ("target", "stimulus")
        if name in check.schema
    }
    properties["tolerance"] = {
        **_description_of("tolerance"),
        "type": "object",
        "properties": {
            name: tolerance_schema(unit) for name, unit in sorted(check.tolerances.items())
        },
        "required": sorted(check.required_tolerances),
        "additionalProperties": False,
    }
    required = ["tolerance"] if check.required_tolerances else []
    required += [
        name for name in ("target", "stimulus") if properties.get(name, {}).get("required")
    ]
    return {"properties": properties, "required": required}


def _description_of(name: str) -> dict[str, str]:
    """Description of a field of every kind, so that editors show it below a kind too."""
    return {"description": str(_COMMON[name]["description"])}


def _write_shipped_schema() -> None:
    """Write the schema file of the package, with the kinds of pytest-twin itself."""
    ours = [kind for kind in kinds() if type(check_of(kind)).__module__.startswith("pytest_twin.")]
    path = Path(__file__).parent.parent / SHIPPED
    atomic.write_text(path, json.dumps(golden_schema(ours), indent=1) + "\n")


if __name__ == "__main__":
    _write_shipped_schema()
