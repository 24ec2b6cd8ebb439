"""The change log of a normalized asset: all changes, and all faults that were kept."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Change:
    """One difference from the source.

    Attributes:
        file: the source file, relative to the source's root.
        line: 1-based line there.
        where: the element and attribute, ``joint 'elbow'.axis``.
        before, after: values as written, with unit; None if the value did not exist or was removed.
        patch: the accepted patch that caused it, None if only the form changed.
    """

    file: str
    line: int
    where: str
    before: str | None
    after: str | None
    why: str
    patch: str | None = None


@dataclass(frozen=True, slots=True)
class Flag:
    """A fault of the source that the normalized asset keeps.

    Attributes:
        value: value as found, with its unit.
        why: what is wrong with it.
        patch: patch that would repair it, or None.
        critical: whether the fault prevents or invalidates every realization.
    """

    file: str
    line: int
    where: str
    value: str
    why: str
    patch: str | None = None
    critical: bool = False


@dataclass(frozen=True, slots=True)
class ChangeLog:
    """Changes and kept faults of a normalized asset, and the command that reproduces it.

    Attributes:
        command: arguments of the command that reproduces the normalized asset.
    """

    command: tuple[str, ...]
    changes: tuple[Change, ...]
    flags: tuple[Flag, ...]

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
        return {
            "schema": 1,
            "command": list(self.command),
            "changes": [asdict(change) for change in self.changes],
            "flags": [asdict(flag) for flag in self.flags],
        }

    def to_markdown(self) -> str:
        """The log as Markdown."""
        lines = [
            "# Change log of the normalized asset",
            "",
            "This command makes the same files, byte for byte:",
            "",
        ]
        lines += [
            "```",
            shlex.join(self.command),
            "```",
            "",
            "## Faults that were kept",
            "",
        ]
        if self.flags:
            lines += _table(
                ("file", "line", "where", "value", "why", "patch"),
                [_row(asdict(flag)) for flag in self.flags],
            )
        else:
            lines.append("None.")
        lines += ["", "## Changes", ""]
        if self.changes:
            lines += _table(
                ("file", "line", "where", "from", "to", "why", "patch"),
                [_row({**asdict(c), "from": c.before, "to": c.after}) for c in self.changes],
            )
        else:
            lines.append("None.")
        return "\n".join(lines) + "\n"


def _row(fields: Mapping[str, Any]) -> dict[str, str]:
    return {key: "" if value is None else str(value) for key, value in fields.items()}


def _table(columns: Sequence[str], rows: Sequence[Mapping[str, str]]) -> list[str]:
    lines = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
    for row in rows:
        cells = (escape_markdown(row[column]) for column in columns)
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def escape_markdown(text: str) -> str:
    """Escape text for one cell of a Markdown table."""
    shown = "".join(c if c.isprintable() else "�" for c in " ".join(text.split()))
    for char in "\\`*_[]<>|":
        shown = shown.replace(char, "\\" + char)
    return shown
