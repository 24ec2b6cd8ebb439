"""The file of accepted audit findings.

A finding is accepted with its value: if the value changes, it is reported again. Lines are not part
of it, so that other edits of the file do not matter.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pytest_twin.formats import atomic, yaml
from pytest_twin.formats.schema import load_schema, validate

if TYPE_CHECKING:
    from pytest_twin.report.ci import Problem

_HEAD = """\
# Findings of `pytest-twin audit-changes` that are accepted, each with its value. A finding with
# another value is reported again. Add the reason as `why`.
"""


class Key(NamedTuple):
    """What identifies a finding in every version of the robot's file."""

    robot: str
    code: str
    element: str
    value: str


def read(path: Path) -> Mapping[Key, str]:
    """Return accepted finding -> reason; empty if there is no such file.

    Raises:
        TwinError: not a file of accepted findings.
    """
    if not path.exists():
        return {}
    document = yaml.load(path)
    validate(document, load_schema("audit_baseline.schema.json"), path)
    return {
        Key(one["robot"], one["code"], one["element"], one.get("value", "")): one.get("why", "")
        for one in document.data["accepted"] or []
    }


def write(path: Path, problems: Iterable[Problem]) -> None:
    """Write findings as accepted; reasons that the file has are kept."""
    reasons = read(path)
    rows = []
    for key in sorted({one.key for one in problems}):
        row = {name: text for name, text in key._asdict().items() if text}
        if reasons.get(key):
            row["why"] = reasons[key]
        rows.append(row)
    text = yaml.dump({"accepted": rows})
    atomic.write_text(path, _HEAD + text)
