"""Print text, coloured on a terminal that supports it.

Output that fails (`| head` closed the pipe, or the disk of a log is full) ends no work: the rest is
discarded, and the exit status of the command says so when the work is done.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable
from typing import TextIO

from pytest_twin.report.text import printable

_failure: OSError | None = None
"""The first failure of output since :func:`take_failure`."""

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
        write_line(text, stream)
        return
    from rich.console import Console
    from rich.text import Text

    styled = Text(text)
    for pattern, style in _RULES:
        styled.highlight_regex(pattern, style)
    Console(file=stream, highlight=False).print(styled, soft_wrap=True)


def show_lines(lines: Iterable[str]) -> None:
    """Print lines, whose names come from files and may contain terminal escape sequences."""
    show("\n".join(printable(line) for line in lines))


def show_error(command: str, text: str) -> None:
    """Print the single line with which a command ends if its input cannot be used."""
    if not _is_coloured(sys.stderr):
        write_line(f"{command}: {text}", sys.stderr)
        return
    from rich.console import Console
    from rich.text import Text

    line = Text.assemble((f"{command}: ", "bold red"), text)
    Console(stderr=True, highlight=False).print(line, soft_wrap=True)


def write_line(text: str, stream: TextIO) -> None:
    """Print a plain line at once; a stream that fails is discarded from then on."""
    global _failure
    try:
        print(text, file=stream, flush=True)
    except OSError as error:
        _failure = _failure or error
        discard(stream)


def discard(stream: TextIO) -> None:
    """Send the rest of a stream to nowhere: Python writes it when it ends, which fails again."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def take_failure() -> OSError | None:
    """Return the first failure of output, and forget it."""
    global _failure
    failure, _failure = _failure, None
    return failure


def _is_coloured(stream: TextIO) -> bool:
    return stream.isatty() and not os.environ.get("NO_COLOR")
