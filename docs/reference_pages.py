"""Write the reference pages from the code: commands, options, golden kinds, files, errors.

    python docs/reference_pages.py FOLDER

The site's build calls :func:`write`, so that a page never differs from the code it describes.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import io
import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from pytest_twin import cli, errors
from pytest_twin.audit.finding import catalogue
from pytest_twin.checks import check_of, kinds
from pytest_twin.servos import library
from pytest_twin.session import options

SCHEMAS = {
    "twin": "`twin.yaml`",
    "evidence": "the evidence file of `audit --evidence`",
    "calibration": "`calibration.yaml`",
    "audit_baseline": "the file of accepted findings of `audit-changes --baseline`",
}
RESULTS = {
    "diagnosis": "`diagnosis.json` and `diagnose --json -`",
    "changes": "`diagnosis.json` of `diagnose --before`, and its `--json -`",
    "trend": "`trend.json` and `trend --json -`",
    "fleet": "`fleet.json` and `diagnose --fleet --json -`",
    "calibrate": "`calibration.json` and `calibrate --json -`",
    "identify": "`identification.json` and `identify --json -`",
    "budget": "`budget.json` and `budget --json -`",
    "randomize": "`ranges.json` and `randomize --json -`",
    "excite": "`excitation.json` and `excite --json -`",
    "replay": "the JSON file beside a prediction, and `replay --json -`",
    "audit": "`NAME.audit.json` and `audit --json -`",
    "audit-changes": "`audit-changes --json -`",
    "init": "`.twin/init.json` and `init --json -`",
    "convert": "the JSON file beside a converted recording, and `convert --json -`",
    "show": "`show --json -`",
    "check-dataset": "`check-dataset.json` and `check-dataset --json -`",
    "verify": "`verify --json -`",
    "stamp": "`stamp --json -`",
    "fresh": "`fresh --json -`",
    "shadow": "`shadow/ID.json` and `shadow --json -`",
    "rollback": "`rollback --json -`",
    "realize": "`realize --json -`",
    "intake": "the asset's `manifest.json` after `intake`, and `intake --json -`",
    "effects": "`effects --json -`",
    "export": "`export.json` and `export --json -`",
    "servo": "`servo --json -`",
}


def commands() -> str:
    """Every command with its help, and the plugin's flags of pytest."""
    lines = [
        "# Commands",
        "",
        "Every command writes its result as JSON with `--json FILE.json`. With `--json -` standard",
        "output holds the JSON document alone, and the text goes to standard error. Unusable input",
        "ends with exit status 2 and one line on standard error; no JSON is written then.",
        "",
        "Progress goes to standard error: a live line on a terminal, one line a minute in a log.",
        "The environment variable `NO_COLOR` turns colours off.",
        "",
        "## pytest",
        "",
        *_table(
            ("flag", "does"),
            [
                *((f"`--{name}`", text) for name, text in options.SWITCHES.items()),
                *(
                    (f"`--{name} {metavar}`", text)
                    for name, (metavar, text) in options.VALUES.items()
                ),
            ],
        ),
        "Each flag may stand in pytest's configuration file too: `twin_release = true`.",
        "",
    ]
    for name in cli.COMMANDS:
        lines += [f"## {name}", "", "```text", _help(name), "```", ""]
    return "\n".join(lines)


def golden_kinds() -> str:
    """Every kind of golden with its tolerances and the fields of its spec."""
    lines = [
        "# Fields of a golden",
        "",
        "Every field of every kind, as the schema in the code states it. What a kind does is on",
        "[its own page](../../kinds.md). `pytest-twin init` writes this schema to",
        "`schemas/golden.schema.json`, where editors find it.",
        "",
    ]
    for kind in kinds():
        check = check_of(kind)
        required = check.required_tolerances
        lines += [f"## {kind}", "", _first_line(type(check)), ""]
        lines += _table(
            ("tolerance", "unit", "required"),
            (
                (f"`{name}`", unit, "yes" if name in required else "")
                for name, unit in check.tolerances.items()
            ),
        )
        schema = check.schema
        definitions = schema.get("$defs", {})
        for part in ("target", "stimulus"):
            if part in schema:
                rows = list(_fields(schema[part], definitions, part))
                lines += _table(("field", "type", "meaning"), rows)
    return "\n".join(lines)


def files() -> str:
    """The files that users write and programs read, field by field."""
    lines = ["# Files", "", "Fields of the files that you write, and of the JSON results.", ""]
    for folder, names in (("", SCHEMAS), ("results/", RESULTS)):
        for name, title in names.items():
            schema = _schema(f"{folder}{name}.schema.json")
            lines += [f"## {title}", ""]
            if "description" in schema:
                lines += [schema["description"], ""]
            rows = list(_fields(schema, schema.get("$defs", {}), ""))
            lines += _table(("field", "type", "meaning"), rows)
    return "\n".join(lines)


def error_types() -> str:
    """Every type of error, with what raises it."""
    found = [
        value
        for _, value in inspect.getmembers(errors, inspect.isclass)
        if issubclass(value, errors.TwinError) and value.__module__ == errors.__name__
    ]
    rows = (
        (f"`{kind.__name__}`", f"`{kind.__bases__[0].__name__}`", _first_line(kind))
        for kind in sorted(found, key=lambda kind: len(kind.__mro__))
    )
    return "\n".join(
        [
            "# Errors",
            "",
            "Every error that a user can cause is a `TwinError` and prints as one line: file,",
            "line, field, what is wrong, the value with its unit, and what was expected. A",
            "command then ends with exit status 2, and pytest fails the golden. Python code",
            "catches the types of `pytest_twin.errors`:",
            "",
            *_table(("type", "is a", "meaning"), rows),
            "Their attributes: `path`, `line`, `column`, `where`, `value`, `unit`, `expected`.",
            "",
        ]
    )


def findings() -> str:
    """Every finding of the audit, with its consequence and the next step."""
    lines = [
        "# Findings of the audit",
        "",
        "[The audit](../../audit.md) names each finding by its code. An empty cell depends on the",
        "robot, and the report states it.",
        "",
    ]
    columns = ("severity", "expected", "why", "settle")
    for layer, names in catalogue().items():
        rows = (
            (f"`{layer}.{name}`", *(fields.get(column, "") for column in columns))
            for name, fields in names.items()
        )
        lines += [f"## {layer}", "", *_table(("finding", *columns), rows)]
    return "\n".join(lines)


API = {
    "pytest_twin.library": "Functions of pytest_twin",
    "pytest_twin.loaded_model": "",
    "pytest_twin.checks": "A kind of golden",
    "pytest_twin.dependency": "",
    "pytest_twin.effects": "An effect",
    "pytest_twin.audit.installed_layers": "An audit layer",
    "pytest_twin.audit.finding": "",
    "pytest_twin.audit.asset": "",
    "pytest_twin.formats.recordings": "Recordings",
    "pytest_twin.formats.recording": "",
    "pytest_twin.realization.model_formats": "Models",
    "pytest_twin.realization.loading": "",
    "pytest_twin.realization.named_model": "",
    "pytest_twin.realization.model": "",
    "pytest_twin.realization.reference": "",
    "pytest_twin.properties": "Property tests",
    "pytest_twin.strategies": "",
}
"""Module that other packages import -> title of the section that begins with it."""


def api() -> str:
    """What packages and tests of users import, from the docstrings."""
    lines = [
        "# Python API",
        "",
        "What your own packages and tests import. [Add your own](../../how-to/add_your_own.md)",
        "shows how the parts belong together. Names with a leading underscore, and modules that",
        "are not on this page, may change between versions.",
        "",
    ]
    for module, title in API.items():
        if title:
            lines += [f"## {title}", ""]
        lines += [f"### {module}", "", "```{eval-rst}", f".. automodule:: {module}"]
        lines += ["   :members:", "```", ""]
    return "\n".join(lines)


PAGES = {
    "api.md": api,
    "commands.md": commands,
    "golden_kinds.md": golden_kinds,
    "files.md": files,
    "errors.md": error_types,
    "findings.md": findings,
    **{
        f"servo_{servo.id}.md": functools.partial(library.page, servo)
        for servo in library.package_servos().values()
    },
}


def write(folder: Path) -> None:
    """Write every page; an unchanged page keeps its time, so that Sphinx reads it once."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        path, text = folder / name, page()
        if not path.is_file() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")


def _help(name: str) -> str:
    written = io.StringIO()
    with contextlib.redirect_stdout(written), contextlib.suppress(SystemExit):
        cli.main([name, "--help"])
    return written.getvalue().rstrip()


def _schema(name: str) -> dict[str, Any]:
    text = resources.files("pytest_twin").joinpath("schemas", *name.split("/")).read_text("utf-8")
    loaded: dict[str, Any] = json.loads(text)
    return loaded


def _fields(
    schema: Mapping[str, Any], definitions: Mapping[str, Any], prefix: str, depth: int = 0
) -> Iterator[tuple[str, str, str]]:
    """One row for each field, nested ones dotted; ``NAME`` where the key is the user's."""
    schema = _resolved(schema, definitions)
    inner = dict(schema.get("properties", {}))
    others = schema.get("additionalProperties")
    if isinstance(others, Mapping):
        inner["NAME"] = others
    for pattern in schema.get("patternProperties", {}).values():
        inner["NAME"] = pattern
    for name, field in inner.items():
        field = _resolved(field, definitions)
        place = f"{prefix}.{name}" if prefix else name
        text = field.get("description", "")
        if name in schema.get("required", ()):
            text = f"{text} (required)".strip()
        yield f"`{place}`", _type(field, definitions), text
        if depth < 3:
            yield from _fields(field, definitions, place, depth + 1)
            items = field.get("items")
            if isinstance(items, Mapping):
                yield from _fields(items, definitions, f"{place}[]", depth + 1)


def _resolved(schema: Any, definitions: Mapping[str, Any]) -> Mapping[str, Any]:
    if not isinstance(schema, Mapping):
        return {}
    if "$ref" in schema:
        target = definitions.get(schema["$ref"].rsplit("/", 1)[-1], {})
        return {
            **_resolved(target, definitions),
            **{k: v for k, v in schema.items() if k != "$ref"},
        }
    return schema


def _type(field: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    if "const" in field:
        return f"`{json.dumps(field['const'])}`"
    if "enum" in field:
        return ", ".join(f"`{json.dumps(value)}`" for value in field["enum"])
    for key in ("anyOf", "oneOf"):
        if key in field:
            inner = (_type(_resolved(each, definitions), definitions) for each in field[key])
            return " or ".join(dict.fromkeys(word for word in inner if word))
    kind = field.get("type", "")
    word = " or ".join(kind) if isinstance(kind, list) else str(kind)
    if word == "array":
        inner_type = _type(_resolved(field.get("items", {}), definitions), definitions)
        return f"array of {inner_type}" if inner_type else "array"
    return word


def _table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    lines = [header, tuple("---" for _ in header), *rows]
    text = ["| " + " | ".join(_cell(c) for c in row) + " |" for row in lines]
    return [*text, ""]


def _cell(text: str) -> str:
    # A bar would end the cell, and <twin> would be a tag.
    return text.replace("|", "\\|").replace("<", "\\<").replace("\n", " ")


def _first_line(thing: Any) -> str:
    return (inspect.getdoc(thing) or "").split("\n\n")[0].replace("\n", " ").replace("``", "`")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
