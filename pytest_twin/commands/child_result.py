"""A result that a child process computes, and that appears in its folder as a whole."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pytest_twin.commands.time_limit import wall_limit
from pytest_twin.formats import results
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.interrupts import StopRequest
from pytest_twin.realization.sandbox import Sandbox


def add_out(parser: argparse.ArgumentParser, content: str) -> None:
    """Add the required folder of the result; ``content`` is its help."""
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help=content)


@contextmanager
def child_result(
    out: Path, main: str, seconds: float, stop: StopRequest | None, *, alone: bool = False
) -> Iterator[tuple[Path, Sandbox]]:
    """Context with an empty folder that becomes the result, and the child that computes it.

    Args:
        out: folder of the result.
        main: name of the main file, which identifies the result in its folder.
        seconds: limit of the processor time that the child itself observes, s; 0 for none.
        stop: request that ends the child early.
        alone: whether a folder with files of others and without an earlier result is refused.

    Raises:
        PathError: as :func:`~pytest_twin.formats.results.result_folder`.
    """
    with (
        results.result_folder(out, main, alone=alone) as staging,
        # The simulator writes its log to the working folder, so use one that is deleted.
        temporary_folder() as scratch,
        Sandbox(seconds=wall_limit(seconds), cwd=scratch, stop=stop) as sandbox,
    ):
        yield staging, sandbox
