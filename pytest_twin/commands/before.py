"""``pytest-twin diagnose --before``: what changed since earlier recordings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pytest_twin.commands import fleet, json_output
from pytest_twin.commands.child_result import child_result
from pytest_twin.commands.numbers import number
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import RECORDING_HELP, recording_options
from pytest_twin.commands.terminal import show, show_lines
from pytest_twin.diagnosis.not_separated import state_not_separated
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.gate.failure_diagnosis import DIAGNOSIS_FILE, REPORT_FILE
from pytest_twin.gate.released_model import model_changes, released_beside
from pytest_twin.gate.since_release import write_comparison
from pytest_twin.loaded_model import find_model
from pytest_twin.release.released_files import copy_release, release_folder
from pytest_twin.report import changes

NO_CHANGE, CHANGED = 0, 1
LEVEL = 0.05
"""Default probability of an alarm if nothing changed."""
parse_level = number(
    lambda level: 0.0 < level <= 0.5, "a probability more than 0 and at most 0.5, such as 0.05"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    group = parser.add_argument_group(
        "what changed since earlier recordings",
        "RECORDING is compared with earlier recordings of the same robot, by measured effort, or "
        "by simulation where efforts are missing; an error that the model had before is no "
        "change, and roles are ignored",
    )
    group.add_argument(
        "--before",
        metavar="RECORDING",
        type=Path,
        nargs="+",
        action="extend",
        default=[],
        help=f"earlier recordings: {RECORDING_HELP}",
    )
    group.add_argument(
        "--alarm-level",
        metavar="P",
        type=parse_level,
        default=LEVEL,
        help=f"probability of an alarm if nothing changed (default: {LEVEL:g})",
    )


def run(args: argparse.Namespace, seconds: float) -> int:
    """Compare; return 0 if nothing changed, else 1.

    Args:
        seconds: limit of the processor time, s; 0 for no limit.

    Raises:
        TwinError: the input cannot be used.
    """
    fleet.refuse_alone(args)
    out: Path = args.out.absolute()
    request = {
        "model": str(find_model(args.model)),
        "new": _absolute(args.recordings),
        "before": _absolute(args.before),
        "held_out": _absolute(args.held_out),
        "topics": args.topics,
        "options": recording_options(args),
        "level": args.alarm_level,
        "seconds": seconds,
    }
    released = released_beside(find_model(args.model).absolute(), args.before)
    if released is not None:
        request["release"] = released.number
    progress = Progress("comparing")
    with (
        progress.stopping_early("the best result so far is written") as stop,
        progress,
        child_result(out, DIAGNOSIS_FILE, seconds, stop, alone=True) as (staging, sandbox),
    ):
        document: dict[str, Any] = sandbox.call(
            "pytest_twin.changes.compare_files:compare_files",
            {"request": request | {"out": str(staging)}},
            progress=progress,
        )
        if released is not None and released.changes:
            with temporary_folder() as copied:
                model = find_model(args.model).absolute()
                folder = release_folder(model.parent, released.release.number)
                document["model_changes"] = model_changes(
                    model, copy_release(released.release, folder, model.parent, copied), sandbox,
                    {"recordings": request["before"], "topics": request["topics"],
                     "options": request["options"]},
                )  # fmt: skip
        if released is not None:
            document["notes"] = [*released.notes, *document["notes"]]
        state_not_separated(document, Path(request["model"]), out)
        write_comparison(staging, document)
    json_output.give(args, document)
    show_lines(changes.words(document))
    show(f"report: {args.out / REPORT_FILE}")
    return NO_CHANGE if document["verdict"] == "no_change" else CHANGED


def _absolute(paths: list[Path]) -> list[str]:
    return [str(path.absolute()) for path in paths]
