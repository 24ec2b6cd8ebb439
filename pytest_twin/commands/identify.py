"""``pytest-twin identify``: identify a robot's parameters from recordings, in stages."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.child_result import add_out, child_result
from pytest_twin.commands.numbers import number
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import (
    add_recording_arguments,
    add_recordings,
    recording_options,
)
from pytest_twin.commands.terminal import show_lines
from pytest_twin.commands.time_limit import add_seconds
from pytest_twin.formats import atomic
from pytest_twin.interrupts import StopRequest
from pytest_twin.loaded_model import find_model
from pytest_twin.report import identification
from pytest_twin.report.priors import prior_sentences

EXAMPLES = (
    "pytest-twin identify twin.yaml fourier.mcap --held-out check.mcap --out identified",
    "pytest-twin identify cube.xml tosses.npz --out cube_contact",
    "pytest-twin replay identified check.mcap --out predicted.mcap",
)
EXIT_STATUS = {
    0: "accepted: every stage that the motion determines reduces the held-out error",
    1: "a stage is rejected, or nothing is held out",
}
ACCEPTED, NOT_ACCEPTED = 0, 1
FILE_NAME, PAGE_NAME = "identification.json", "identification.html"


_POSITIVE = number(lambda value: 0.0 < value < math.inf, "a number greater than 0")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        type=Path,
        help="MJCF or URDF file, twin.yaml, or the folder of a diagnosis or identification",
    )
    add_recordings(
        parser,
        nargs="+",
        held_out="recordings that test every stage and are not fitted (default: those with the "
        "role held_out in their metadata, else the last of every four)",
    )
    add_out(
        parser,
        f"folder for {FILE_NAME}, {PAGE_NAME} and realization/, the fitted model; an earlier "
        "identification is replaced",
    )
    parser.add_argument(
        "--id",
        metavar="ID",
        help="id of the record, for fit: of twin.yaml and for goldens (default: the name of DIR)",
    )
    add_seconds(
        parser, 0.0, "the stages so far are written, and the others are listed as not tried"
    )
    _add_toss_arguments(parser)
    add_recording_arguments(parser)
    model_files.add_arguments(parser)


def _add_toss_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--sensor",
        metavar="NAME=TOPIC@FRAME",
        type=parse_sensor,
        action="append",
        default=[],
        help="a force-torque sensor (geometry_msgs/WrenchStamped) or an IMU (sensor_msgs/Imu) at a "
        "site or body of the model; only its bias, scale, coupling and filter are estimated",
    )
    group = parser.add_argument_group(
        "tosses of a free object",
        "RECORDING is an .npz file with one array of poses and velocities for each toss, or bags "
        "with poses; the contact parameters of the model's free body are identified",
    )
    group.add_argument(
        "--pose-topic",
        metavar="TOPIC",
        help="topic of the object's geometry_msgs/PoseStamped, if the bags are tosses of an object",
    )
    group.add_argument(
        "--wrench-topic",
        metavar="TOPIC",
        help="with --pose-topic: topic of geometry_msgs/WrenchStamped with the force and torque "
        "that pushed the object; frame_id is the body's name or world",
    )
    group.add_argument(
        "--body", metavar="NAME", help="the tossed body, if the model has several free bodies"
    )
    group.add_argument(
        "--length-unit",
        metavar="M",
        type=_POSITIVE,
        help="length of one unit of the .npz file in m (default: detected from the free fall at "
        "the start of the tosses, and reported)",
    )
    group.add_argument(
        "--rate",
        metavar="HZ",
        type=_POSITIVE,
        help="sampling rate of the .npz file in Hz (default: detected from displacements and "
        "velocities, and reported)",
    )


def parse_sensor(text: str) -> dict[str, str]:
    """Parse ``NAME=TOPIC@FRAME`` of a command line."""
    name, _, rest = text.partition("=")
    topic, _, frame = rest.partition("@")
    if not (name and topic and frame):
        raise argparse.ArgumentTypeError(f"{text!r}: expected NAME=TOPIC@FRAME")
    return {"name": name, "topic": topic, "frame": frame}


def run(args: argparse.Namespace) -> int:
    """Identify; return 0 if accepted, 1 if a stage is rejected.

    Raises:
        TwinError: the input cannot be used.
    """
    arguments = {
        "seconds": args.seconds,
        "topics": args.topics,
        "options": recording_options(args),
        "sensors": args.sensor,
        "tosses": {
            "length": args.length_unit,
            "rate": args.rate,
            "body": args.body,
            "topic": args.pose_topic,
            "wrench": args.wrench_topic,
        },
    }
    out: Path = args.out.absolute()
    if args.id:
        arguments["name"] = args.id
    progress = Progress("identifying")
    with progress.stopping_early("the stages so far are written") as stop:
        with progress:
            document = identify_into(
                out, args.model, args.recordings, args.held_out, arguments, stop, progress
            )
        json_output.give(args, document)
        show_lines(_words(document, args.out))
    return ACCEPTED if document["verdict"] == "accepted" else NOT_ACCEPTED


# Files, options and the two ways to its parent are independent of each other.
def identify_into(
    out: Path,
    model: Path,
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    arguments: Mapping[str, Any],
    stop: StopRequest | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Identify in a child process, write the folder atomically, and return the document.

    Args:
        out: absolute path of a new or empty folder, or of an earlier identification.
        model, recordings, held_out: files and folders, as on the command line.
        arguments: further fields of ``IdentificationRequest``.
        stop: request that ends the identification early.

    Raises:
        TwinError: the input cannot be used.
    """
    model_file = find_model(model)
    seconds = arguments.get("seconds", 0.0)
    with child_result(out, FILE_NAME, seconds, stop, alone=True) as (staging, sandbox):
        document: dict[str, Any] = sandbox.call(
            "pytest_twin.identification.identify_files:identify_files",
            {
                "request": {
                    "model": str(model_file),
                    "recordings": [str(r.absolute()) for r in recordings],
                    "held_out": [str(r.absolute()) for r in held_out],
                    "out": str(staging),
                    "folder": str(out),
                    "name": out.name,
                    **arguments,
                }
            },
            progress=progress,
        )
        atomic.write_json(staging / FILE_NAME, document)
        atomic.write_text(staging / PAGE_NAME, identification.render(document))
    return document


def _words(document: dict[str, Any], out: Path) -> list[str]:
    lines = [f"{document['verdict'].capitalize()}: identified from {document['way']}"]
    for stage in document["stages"]:
        lines.append(f"  {stage['stage']}: {stage['state'].replace('_', ' ')}: {stage['why']}")
    lines += [f"error on {document['tested_on']}:"]
    lines += [f"  {line}" for line in identification.error_lines(document)]
    lines += prior_sentences(document)
    if "estimator" in document:
        lines.append(f"{document['estimator']['name']}: {document['estimator']['why']}")
    if wider := document.get("bootstrap", {}).get("wider"):
        lines.append(f"wider intervals by a bootstrap over blocks: {', '.join(wider)}")
    lines += [
        f"suspected: {one['what']}; to correct it: {one['mend']}"
        for one in document.get("suspected", ())
    ]
    lines += [f"without a usable effort: {joint}" for joint in document.get("without_effort", ())]
    lines += [
        f"not observable: {', '.join(names)}; to identify it: {motion}"
        for motion, names in identification.by_motion(document).items()
    ]
    if design := identification.mechanisms(document):
        lines.append(
            "pytest-twin excite designs such motions: excitation: mechanisms: "
            f"[{', '.join(design)}] in twin.yaml"
        )
    lines += [
        f"correlated: {' and '.join(one['pair'])} ({one['correlation']:+.2f})"
        for one in document.get("correlated", ())
    ]
    lines += [f"note: {note}" for note in document["notes"]]
    lines.append(f"report: {out / PAGE_NAME}")
    return lines
