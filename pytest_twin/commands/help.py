"""Format ``--help``, and errors of the command line on one line."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NoReturn

UNUSABLE_INPUT = 2
"""Exit status of all commands for unusable input, as that of argparse."""
_UNUSABLE = "unusable input; one line on standard error states file, place and remedy"


class _HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keeps line breaks, and lists subcommands in groups."""

    def __init__(self, prog: str, *, groups: Mapping[str, Iterable[str]]) -> None:
        super().__init__(prog, max_help_position=16 if groups else 24)
        self._groups = groups

    def _format_action(self, action: argparse.Action) -> str:
        if not isinstance(action, argparse._SubParsersAction):
            return super()._format_action(action)
        commands = {entry.dest: entry for entry in action._get_subactions()}
        lines = []
        for title, names in self._groups.items():
            lines.append(f"\n{title}:\n")
            for name in names:
                lines.append(super()._format_action(commands[name]))
        return "".join(lines)


class Parser(argparse.ArgumentParser):
    """An argument parser that keeps line breaks in its help and answers errors in one line."""

    def __init__(
        self, *args: Any, groups: Mapping[str, Iterable[str]] | None = None, **options: Any
    ) -> None:
        """Create the parser.

        Args:
            args, options: those of ``ArgumentParser``.
            groups: title -> names of subcommands, as the help lists them.
        """
        options.setdefault("formatter_class", partial(_HelpFormatter, groups=groups or {}))
        super().__init__(*args, **options)

    def error(self, message: str) -> NoReturn:
        """Print one line on standard error and exit with status 2."""
        line = "".join(c if c.isprintable() else "�" for c in message)
        self.exit(UNUSABLE_INPUT, f"{self.prog}: {line}; see {self.prog} --help\n")


def epilog(examples: Sequence[str], exit_status: Mapping[int, str]) -> str:
    """Return the end of a command's help: examples, and the meaning of each exit status."""
    rows = {**exit_status, UNUSABLE_INPUT: _UNUSABLE}
    return "\n".join(
        [
            "examples:" if len(examples) > 1 else "example:",
            *(f"  {line}" for line in examples),
            "",
            "exit status:",
            *(f"  {status}  {meaning}" for status, meaning in sorted(rows.items())),
        ]
    )


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ``; did you mean 'audit'?`` if a known word is similar, else nothing."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def options_of(parser: argparse.ArgumentParser) -> list[str]:
    """Return the long options of a parser."""
    return sorted(set(re.findall(r"--[a-z][a-z-]*", parser.format_usage())))
