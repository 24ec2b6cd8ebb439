"""The option ``--json`` of every command: write the result for programs.

With ``--json -`` standard output has only the JSON document, and text for people goes to standard
error. ``--json FILE.json`` writes the document to a file and does not change the other output. A
command that ends with exit status 2 writes no document.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from pytest_twin.formats import atomic

STANDARD_OUTPUT = "-"


def add_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the option."""
    parser.add_argument(
        "--json",
        metavar="FILE.json",
        nargs="?",
        const=STANDARD_OUTPUT,
        type=_target,
        help="also write the result as JSON; with '-' or without a name it goes to standard "
        "output, and the text goes to standard error",
    )


def give(args: argparse.Namespace, document: Mapping[str, Any]) -> None:
    """Store the command's result, which is written when the command ends."""
    args.result = document


def text_stream(args: argparse.Namespace) -> AbstractContextManager[object]:
    """Return a context in which the command's text goes to the right stream."""
    if getattr(args, "json", None) == STANDARD_OUTPUT:
        return contextlib.redirect_stdout(sys.stderr)
    return contextlib.nullcontext()


def write(args: argparse.Namespace) -> None:
    """Write the result as requested by ``--json``.

    Raises:
        PathError: the file cannot be written.
    """
    target = getattr(args, "json", None)
    if target is None:
        return
    text = atomic.json_text(args.result)
    if target == STANDARD_OUTPUT:
        sys.stdout.write(text)
    else:
        atomic.write_text(Path(target), text)


def _target(word: str) -> str:
    # Without this rule `audit --json robot.urdf` would overwrite the robot with its report.
    if word != STANDARD_OUTPUT and not word.endswith(".json"):
        raise argparse.ArgumentTypeError(
            f"{word!r} is not a name of a JSON file (expected FILE.json, or - for standard output)"
        )
    if word != STANDARD_OUTPUT and not Path(word).absolute().parent.is_dir():
        raise argparse.ArgumentTypeError(f"{word!r}: its folder does not exist")
    return word
