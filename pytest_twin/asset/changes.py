"""The change log of a normalized asset: every fix, and every fault that was left standing."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that differs from the source.

    Attributes:
        file: the source file, relative to the source's root.
        line: 1-based line there.
        where: the element and attribute, ``joint 'elbow'.axis``.
        before, after: as written, with the unit; None where it was not there, or is not any more.
        why: the reason, in words.
        patch: the named patch that a person accepted, None for what is only form.
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
    """A fault of the source that stands in the normalized asset too.

    Attributes:
        value: as found, with its unit.
        why: what is wrong with it.
        patch: the named patch that would repair it, None where only evidence can.
        critical: no realization can be trusted, or even made, while it stands.
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
    """What was done, what was not, and how to do it again.

    Attributes:
        command: the words of the command that makes the same normalized asset.
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
        """The log as people read it."""
        lines = ["# Change log of the normalized asset", "", "Made again, byte for byte, by:", ""]
        lines += [
            "```",
            shlex.join(self.command),
            "```",
            "",
            "## What stands although it is wrong",
            "",
        ]
        if self.flags:
            lines += _table(
                ("file", "line", "where", "value", "why", "patch"),
                [_row(asdict(flag)) for flag in self.flags],
            )
        else:
            lines.append("Nothing was found.")
        lines += ["", "## What was changed", ""]
        if self.changes:
            lines += _table(
                ("file", "line", "where", "from", "to", "why", "patch"),
                [_row({**asdict(c), "from": c.before, "to": c.after}) for c in self.changes],
            )
        else:
            lines.append("Nothing.")
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
    """Text from a file as one cell of a table, where nothing in it is markup."""
    shown = "".join(c if c.isprintable() else "�" for c in " ".join(text.split()))
    for char in "\\`*_[]<>|":
        shown = shown.replace(char, "\\" + char)
    return shown
