"""Print text, coloured on a terminal that supports it."""

from __future__ import annotations

import os
import sys
from typing import TextIO

# A word or mark at the start of a line determines its colour by severity.
_RULES = (
    (r"(?m)^(?:(X|FAILS|Unexplained|does not hold)\b.*)$", "bold red"),
    (r"(?m)^\s*(?:(!|Improved|left out)(?=[ :]).*)$", "yellow"),
    (r"(?m)^(?:(Explained|No mismatch|holds)\b.*)$", "bold green"),
    (r"(?im)^\s*(?:note|report|next):", "cyan"),
)


def show(text: str, *, error: bool = False) -> None:
    """Print ``text`` on standard output, or on standard error.

    The environment variable ``NO_COLOR`` keeps a terminal's text plain.
    """
    stream = sys.stderr if error else sys.stdout
    if not _is_coloured(stream):
        print(text, file=stream)
        return
    from rich.console import Console
    from rich.text import Text

    styled = Text(text)
    for pattern, style in _RULES:
        styled.highlight_regex(pattern, style)
    Console(file=stream, highlight=False).print(styled, soft_wrap=True)


def show_error(command: str, text: str) -> None:
    """Print the single line with which a command ends if its input cannot be used."""
    if not _is_coloured(sys.stderr):
        print(f"{command}: {text}", file=sys.stderr)
        return
    from rich.console import Console
    from rich.text import Text

    line = Text.assemble((f"{command}: ", "bold red"), text)
    Console(stderr=True, highlight=False).print(line, soft_wrap=True)


def _is_coloured(stream: TextIO) -> bool:
    return stream.isatty() and not os.environ.get("NO_COLOR")
