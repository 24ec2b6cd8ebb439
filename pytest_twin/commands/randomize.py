"""``pytest-twin randomize``: compute randomization ranges from a twin's records and check them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.child_result import add_out, child_result
from pytest_twin.commands.numbers import number
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import (
    RECORDING_HELP,
    add_recording_arguments,
    recording_options,
)
from pytest_twin.commands.release_folder import TWIN_HELP, twin_file
from pytest_twin.commands.terminal import show, show_lines
from pytest_twin.commands.time_limit import add_seconds
from pytest_twin.formats import atomic
from pytest_twin.ranges.files import write_files
from pytest_twin.report import ranges

EXAMPLES = (
    "pytest-twin randomize twin.yaml --out ranges/",
    "pytest-twin randomize cell/ --final final_1.mcap final_2.mcap --out ranges/",
    "pytest-twin randomize cell/ --against events_cfg.py --out ranges/",
)
EXIT_STATUS = {
    0: "the envelope contains the stated share of the final recordings and is not too wide",
    1: "the envelope contains a smaller share or is too wide, or there are no final recordings",
}
JSON_NAME, PAGE_NAME = "ranges.json", "ranges.html"
_FEWEST_ROBOTS = 32
"""As for ``ranges: draws:`` of ``twin.yaml``."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("twin", metavar="TWIN", type=Path, help=TWIN_HELP)
    parser.add_argument(
        "--final",
        metavar="RECORDING",
        type=Path,
        nargs="+",
        default=[],
        help=f"recordings that were used for nothing else and check the ranges: {RECORDING_HELP} "
        "(default: ranges: final: of twin.yaml, else those in recordings/ with the role final)",
    )
    parser.add_argument(
        "--held-out",
        metavar="RECORDING",
        type=Path,
        nargs="+",
        default=[],
        help="recordings that were not fitted; if they deviate more than the ranges predict, the "
        "ranges are widened",
    )
    parser.add_argument(
        "--draws",
        metavar="N",
        type=robots,
        help="number of simulated robots (default: as in twin.yaml, else 256)",
    )
    parser.add_argument(
        "--share",
        metavar="P",
        type=number(lambda share: 0.5 < share < 1.0, "a fraction between 0.5 and 1, such as 0.95"),
        help="fraction of the samples that should lie in the envelope (default: as in twin.yaml, "
        "else 0.95)",
    )
    parser.add_argument(
        "--against",
        metavar="FILE",
        type=Path,
        help="ranges for comparison: a ranges.json, a table NAME: [low, high], or events of Isaac "
        "Lab or mjlab as .yaml or .py, whose code is not run",
    )
    add_out(
        parser, f"folder for {JSON_NAME}, {PAGE_NAME}, a sampler and configurations of simulators"
    )
    add_seconds(parser, 0.0, "the ranges are written with the robots that were simulated")
    add_recording_arguments(parser)
    model_files.add_arguments(parser)


def robots(text: str) -> int:
    """Parse a number of robots of a command line."""
    count = int(text) if text.isdecimal() else 0
    if count < _FEWEST_ROBOTS:
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected a whole number of at least {_FEWEST_ROBOTS} robots"
        )
    return count


def run(args: argparse.Namespace) -> int:
    """Write the ranges; return 0 if the final recordings are within a useful envelope, else 1.

    Raises:
        TwinError: a twin, record or recording cannot be used.
    """
    twin = twin_file(args.twin)
    out: Path = args.out
    progress = Progress("simulating")
    with progress.stopping_early("the ranges so far are written") as stop:
        with (
            child_result(out, JSON_NAME, args.seconds, stop) as (staging, sandbox),
            progress,
        ):
            document = sandbox.call(
                "pytest_twin.ranges.ranges_of_twin:ranges_of_file",
                {
                    "path": str(twin.absolute()),
                    "request": {
                        "final": [str(path.absolute()) for path in args.final],
                        "held_out": [str(path.absolute()) for path in args.held_out],
                        "draws": args.draws,
                        "seconds": args.seconds,
                        "folder": str(out.absolute()),
                        "share": args.share,
                        "options": recording_options(args),
                        "topics": args.topics,
                        "against": None if args.against is None else str(args.against.absolute()),
                    },
                },
                progress=progress,
            )
            atomic.write_json(staging / JSON_NAME, document)
            atomic.write_text(staging / PAGE_NAME, ranges.render(document))
            write_files(staging)
        json_output.give(args, document)
        show_lines(_words(document))
        show(f"report: {out / PAGE_NAME}, {out / JSON_NAME}")
        return 0 if document["verdict"] == "useful" else 1


def _words(document: dict[str, Any]) -> list[str]:
    """Return the summary for people."""
    lines = [f"randomization ranges of {document['twin']!r}"]
    lines += [f"  {line}" for line in document["words"]]
    return [*lines, *(f"  note: {note}" for note in document["notes"])]
