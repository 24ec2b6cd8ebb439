"""Command-line options of every command that reads recordings."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pytest_twin.commands.numbers import number
from pytest_twin.formats.base_pose import ROLE
from pytest_twin.formats.recording import TOPICS
from pytest_twin.recording_options import (
    BASES,
    CLOCKS,
    COMMAND_BETWEEN,
    COMMAND_MODES,
    LONGEST_PERIOD,
    TIME_UNITS,
    UNITS,
    CommandMode,
)

RECORDING_HELP = (
    "MCAP file, rosbag2 folder, .db3 file, CSV file, or the folder of a LeRobot data set"
)
_OPTIONS = (
    "topics", "joints", "command_mode", "clock", "command_between", "controller_period", "base",
    "columns", "units", "time_unit", "motor_calibration",
)  # fmt: skip


def add_recordings(
    parser: argparse.ArgumentParser, *, nargs: Literal["*", "+"], held_out: str
) -> None:
    """Declare RECORDING and ``--held-out``.

    Args:
        nargs: number of recordings, as for argparse.
        held_out: help text: purpose and default of the held-out recordings.
    """
    parser.add_argument(
        "recordings", metavar="RECORDING", type=Path, nargs=nargs, help=RECORDING_HELP
    )
    parser.add_argument(
        "--held-out",
        metavar="RECORDING",
        type=Path,
        nargs="+",
        action="extend",
        default=[],
        help=held_out,
    )


def add_recording_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options for reading recordings."""
    group = parser.add_argument_group(
        "how recordings are read", "each option overrides the key of the same name in twin.yaml"
    )
    add_topics_argument(group, "twin.yaml's, else ")
    group.add_argument(
        "--joints",
        metavar="prefix=left_|RECORDED=MODEL,...",
        type=parse_joints,
        default={},
        help="joint names of the recording: a prefix or suffix of the model's names, or single "
        "names",
    )
    group.add_argument(
        "--command-mode",
        metavar="MODE|JOINT=MODE,...",
        type=parse_command_mode,
        help="field of the commands that is used: position, velocity or effort, for all joints or "
        "for each (default: the one that the model's actuator takes)",
    )
    group.add_argument(
        "--clock",
        choices=CLOCKS,
        help="times from header stamps or from the recorder's log (default: stamps if both topics "
        "have them and they overlap)",
    )
    group.add_argument(
        "--command-between",
        choices=COMMAND_BETWEEN,
        help="how a command changes between two stamps: held until the next, interpolated to the "
        "next, or ramped to the next within one period (default: as the recording's metadata or "
        "twin.yaml states, else held)",
    )
    group.add_argument(
        "--controller-period",
        metavar="SECONDS",
        type=number(
            lambda period: 0.0 < period <= LONGEST_PERIOD,
            f"a period in s, more than 0 and at most {LONGEST_PERIOD:g}",
        ),
        help="update period of a controller that plays trajectories and holds each setpoint for "
        "it: 0.008, for example (default: the trial's metadata or twin.yaml, else the setpoint "
        "moves on continuously, with a note)",
    )
    group.add_argument(
        "--base",
        choices=BASES,
        help="fixed: a rig held the robot, so that the model's floating base stays where it is "
        "(default: a floating base moves along its recorded pose, and is refused without one)",
    )
    add_reading_arguments(group)


def add_topics_argument(group: argparse._ActionsContainer, before: str = "") -> None:
    """Declare ``--topics``; ``before`` describes what overrides the default topics."""
    group.add_argument(
        "--topics",
        metavar="state=/x,command=/y",
        type=parse_topics,
        default={},
        help=f"topics of the recordings (default: {before}"
        + ",".join(f"{role}={topic}" for role, topic in TOPICS.items())
        + f"); {ROLE}=/z for the pose of a floating base",
    )


def add_reading_arguments(group: argparse._ActionsContainer) -> None:
    """Declare the options of single formats."""
    group.add_argument(
        "--columns",
        metavar="HEADER=MEANING,...",
        type=parse_columns,
        default={},
        help="for a CSV file with other headers: time, NAME.position, NAME.velocity, NAME.effort "
        "or NAME.command as the meaning of each",
    )
    group.add_argument(
        "--time-unit",
        choices=TIME_UNITS,
        help="for a CSV file: unit of its times (default: the heading's, else detected from dates "
        "and sampling rate and reported)",
    )
    add_lerobot_arguments(group)


def add_lerobot_arguments(group: argparse._ActionsContainer) -> None:
    """Declare the unit of angles, and the calibration that converts those in per cent."""
    group.add_argument(
        "--units",
        choices=UNITS,
        help="unit of angles and angular velocities, but for columns that state one; percent (of "
        "the calibrated range) for a LeRobot data set (default: rad; for a LeRobot data set the "
        "declared unit, else detected from the values and reported)",
    )
    group.add_argument(
        "--motor-calibration",
        metavar="FILE.json",
        type=Path,
        help="for a LeRobot data set: the arm's motor calibration, which converts per cent of a "
        "joint's range to angles",
    )


def reading_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options of :func:`add_reading_arguments`, in the form for ``RecordingOptions``."""
    return {
        "columns": args.columns,
        "units": args.units,
        "time_unit": args.time_unit,
        "motor_calibration": args.motor_calibration and str(args.motor_calibration),
    }


def recording_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options of a command line, in the form for ``RecordingOptions.from_json``."""
    given = {
        "joints": args.joints,
        "command_mode": args.command_mode,
        "clock": args.clock,
        "command_between": args.command_between,
        "controller_period": args.controller_period,
        **reading_options(args),
        "base": args.base,
    }
    return {key: value for key, value in given.items() if value}


def options_as_typed(args: argparse.Namespace) -> str:
    """Return the options of a command line that say how a recording is read; with a space before.

    What a message proposes to run has to read the recording as this command did.
    """
    words = []
    for name in _OPTIONS:
        value = getattr(args, name, None)
        if not value:
            continue
        pairs = isinstance(value, Mapping)
        text = ",".join(f"{k}={v}" for k, v in value.items()) if pairs else str(value)
        words += [f"--{name.replace('_', '-')}", shlex.quote(text)]
    for name in ("root", "package"):
        words += [
            w for value in getattr(args, name, []) for w in (f"--{name}", shlex.quote(str(value)))
        ]
    return "".join(f" {word}" for word in words)


def parse_topics(text: str) -> dict[str, str]:
    """Parse ``state=/x,command=/y`` of a command line."""
    found: dict[str, str] = {}
    for item in text.split(","):
        role, separator, topic = item.partition("=")
        if not separator or role not in (*TOPICS, ROLE) or not topic or role in found:
            raise argparse.ArgumentTypeError(
                f"{text!r}: expected state=/x,command=/y or one of them, and {ROLE}=/z for the "
                "pose of a floating base"
            )
        found[role] = topic
    return found


def parse_joints(text: str) -> dict[str, str]:
    """Parse ``prefix=left_`` or ``left_elbow=elbow,...`` of a command line."""
    return _pairs(text, "prefix=TEXT, suffix=TEXT or RECORDED=MODEL, with commas between")


def parse_columns(text: str) -> dict[str, str]:
    """Parse ``t=time,q1=elbow.position`` of a command line."""
    return _pairs(text, "HEADER=MEANING with commas between")


def parse_trial(text: str) -> dict[str, str]:
    """Parse ``role=fit,payload=kg05`` of a command line."""
    found = _pairs(text, "KEY=VALUE with commas between")
    if not all(text.isprintable() for pair in found.items() for text in pair):
        raise argparse.ArgumentTypeError(f"{text!r}: expected printable text")
    return found


def parse_command_mode(text: str) -> CommandMode | dict[str, str]:
    """Parse ``position`` or ``elbow=effort,...`` of a command line."""
    for mode in COMMAND_MODES:
        if text == mode:
            return mode
    expected = f"{', '.join(COMMAND_MODES)}, or JOINT=MODE with commas between"
    found = _pairs(text, expected)
    if not set(found.values()) <= set(COMMAND_MODES):
        raise argparse.ArgumentTypeError(f"{text!r}: expected {expected}")
    return found


def _pairs(text: str, expected: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for item in text.split(","):
        key, separator, value = item.partition("=")
        if not separator or not key or not value or key in found:
            raise argparse.ArgumentTypeError(f"{text!r}: expected {expected}")
        found[key] = value
    return found
