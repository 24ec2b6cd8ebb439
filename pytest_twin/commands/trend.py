"""``pytest-twin trend``: parameters and errors of a robot over dated recordings."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pytest_twin.commands import fleet, json_output, model_files
from pytest_twin.commands.before import LEVEL, parse_level
from pytest_twin.commands.child_result import add_out, child_result
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import (
    RECORDING_HELP,
    add_recording_arguments,
    recording_options,
)
from pytest_twin.commands.terminal import show, show_lines
from pytest_twin.commands.time_limit import add_seconds, wall_limit
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic, results
from pytest_twin.interrupts import StopRequest
from pytest_twin.loaded_model import find_model
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.report import trend

EXAMPLES = (
    "pytest-twin trend twin.yaml recordings/*.mcap --out trend",
    "pytest-twin trend --fleet fleet.yaml --out trends",
)
EXIT_STATUS = {0: "no alarm", 1: "an alarm: a parameter or an error changed"}
NO_ALARM, ALARM = 0, 1
FILE_NAME, PAGE_NAME = "trend.json", "trend.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "model", metavar="TWIN", type=Path, nargs="?",
        help="twin.yaml or its folder",
    )  # fmt: skip
    parser.add_argument(
        "recordings", metavar="RECORDING", type=Path, nargs="*",
        help=f"{RECORDING_HELP}, with measured effort and stamps since 1970, or date: in the "
        "metadata of the trial",
    )  # fmt: skip
    add_out(parser, f"folder for {FILE_NAME} and {PAGE_NAME}")
    parser.add_argument(
        "--alarm-level", metavar="P", type=parse_level, default=LEVEL,
        help=f"probability of an alarm for a robot if nothing changed (default: {LEVEL:g})",
    )  # fmt: skip
    fleet.add_arguments(parser, "follow")
    add_seconds(
        parser, 0.0,
        "the recordings that were read are followed, and the others are named; with --fleet, each "
        "robot has an equal share",
    )  # fmt: skip
    add_recording_arguments(parser)
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Follow a robot; return 0 without an alarm, else 1.

    Raises:
        TwinError: the input cannot be used.
    """
    arguments = {
        "topics": args.topics,
        "options": recording_options(args),
        "level": args.alarm_level,
        "seconds": args.seconds,
    }
    if args.fleet is not None:
        if args.model is not None:
            raise TwinError(
                "TWIN and RECORDING are in the fleet file", where=str(args.model),
                expected="only --fleet FILE.yaml and options",
            )  # fmt: skip
        return fleet.run(args, arguments, TASK)
    if args.model is None or not args.recordings:
        raise TwinError(
            "no model or no recording", where="TWIN RECORDING...",
            expected="TWIN and at least one RECORDING",
        )  # fmt: skip
    fleet.refuse_alone(args)
    progress = Progress("following")
    with progress.stopping_early("the recordings that were read are followed") as stop, progress:
        document = follow_into(
            args.out.absolute(), args.model, args.recordings, arguments, stop, progress
        )
    json_output.give(args, document)
    show_lines(trend.words(document))
    show(f"report: {args.out / PAGE_NAME}")
    return NO_ALARM if document["verdict"] == "no_alarm" else ALARM


def follow_into(
    out: Path,
    model: Path,
    recordings: Sequence[Path],
    arguments: Mapping[str, Any],
    stop: StopRequest | None = None,
    progress: Progress | None = None,
    child: Sandbox | None = None,
) -> dict[str, Any]:
    """Follow one robot into a folder; return the content of ``trend.json``.

    Args:
        arguments: fields of ``TrendRequest`` other than files.
        child: process that estimates; a new one by default.

    Raises:
        TwinError: the input cannot be used.
    """
    request = {
        "model": str(find_model(model)),
        "recordings": [str(path.absolute()) for path in recordings],
        **arguments,
    }
    with ExitStack() as opened:
        if child is None:
            staging, child = opened.enter_context(
                child_result(out, FILE_NAME, arguments["seconds"], stop, alone=True)
            )
        else:
            staging = opened.enter_context(results.result_folder(out, FILE_NAME, alone=True))
        document: dict[str, Any] = child.call(
            "pytest_twin.trend.trend:follow_files",
            {"request": request},
            seconds=wall_limit(arguments["seconds"]),
            progress=progress,
        )
        atomic.write_json(staging / FILE_NAME, document)
        # Of a robot of a fleet, only joints with an alarm are drawn.
        page = trend.render(document, every=progress is not None)
        atomic.write_text(staging / PAGE_NAME, page)
    return document


def follow_robot(robot: fleet.Robot, options: fleet.Options) -> str:
    """Follow one robot of a fleet; return its verdict."""
    document = follow_into(
        options.out / robot.name, robot.model, robot.recordings, options.arguments, options.stop,
        child=_child_of(options),
    )  # fmt: skip
    return str(document["verdict"])


_children: dict[int, tuple[fleet.Options, Sandbox]] = {}
"""Process of a fleet -> its options and its child."""


def _child_of(options: fleet.Options) -> Sandbox:
    """The child of this process of a fleet: its start takes longer than to follow a robot."""
    process = os.getpid()
    known = _children.get(process)
    if known is None or known[0] is not options:
        _children.clear()
        _children[process] = options, Sandbox(stop=options.stop)
    return _children[process][1]


TASK = fleet.Task(follow_robot, frozenset({"alarm"}), PAGE_NAME, "not followed")
