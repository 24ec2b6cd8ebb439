"""``pytest-twin check-dataset``: check a LeRobot data set without a twin."""

from __future__ import annotations

import argparse
from pathlib import Path

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import add_lerobot_arguments
from pytest_twin.commands.terminal import show
from pytest_twin.errors import SpecError
from pytest_twin.formats import atomic, results
from pytest_twin.loaded_model import find_model
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.report.dataset import render, text

EXAMPLES = (
    "pytest-twin check-dataset datasets/pick",
    "pytest-twin check-dataset datasets/pick --motor-calibration follower.json --robot so101.urdf",
    "pytest-twin check-dataset datasets/pick --json - | jq '.findings[].text'",
)
EXIT_STATUS = {0: "nothing found", 1: "something found"}
CLEAN, FOUND = 0, 1
MAIN = "check-dataset.json"
_PAGE = "check-dataset.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("dataset", metavar="DIR", type=Path, help="folder of the data set")
    parser.add_argument(
        "--robot",
        metavar="FILE",
        type=Path,
        help="URDF, MJCF or twin.yaml, for the limits of the joints; or the arm's calibration by "
        "LeRobot (.json)",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path(),
        help=f"folder for {MAIN} and {_PAGE} (default: the working directory)",
    )
    add_lerobot_arguments(parser)
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Check a data set; return 0 if nothing is found, else 1.

    Raises:
        TwinError: the data set, the calibration or the model cannot be read.
    """
    robot, calibration = args.robot, args.motor_calibration
    if robot is not None and robot.suffix.lower() == ".json":
        if calibration is not None:
            raise SpecError("two motor calibrations", path=robot, where="--robot", expected="one")
        robot, calibration = None, robot
    with (
        results.result_folder(args.out, MAIN) as staging,
        Sandbox() as sandbox,
        Progress("checking") as progress,
    ):
        document = sandbox.call(
            "pytest_twin.dataset.check:check_dataset",
            {
                "path": str(args.dataset),
                "units": args.units,
                "motor_calibration": None if calibration is None else str(calibration),
                "robot": None if robot is None else str(find_model(robot)),
            },
            progress=progress,
        )
        atomic.write_json(staging / MAIN, document)
        atomic.write_text(staging / _PAGE, render(document))
    json_output.give(args, document)
    show(text(document))
    show(f"report: {args.out / _PAGE}, {args.out / MAIN}")
    return FOUND if document["findings"] else CLEAN
