"""``pytest-twin convert``: write recordings of any format as MCAP."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.recording_arguments import (
    RECORDING_HELP,
    add_reading_arguments,
    add_topics_argument,
    parse_trial,
    reading_options,
)
from pytest_twin.commands.terminal import show_lines
from pytest_twin.errors import RecordingError, TwinError
from pytest_twin.formats import atomic, results
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import TOPICS, JointSeries, Recording
from pytest_twin.formats.recordings import read_recordings
from pytest_twin.formats.recordings.candidates import pairs, topics_option, what_to_do
from pytest_twin.formats.ros_serialization import QUANTITIES
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.recording_options import COMMAND_MODES, RecordingOptions
from pytest_twin.trial.stream_checks import doubts

EXAMPLES = (
    "pytest-twin convert bag/ --out moves.mcap",
    "pytest-twin convert log.csv --out log.mcap --columns t=time,q1=elbow.position",
    "pytest-twin convert dataset/ --out episode.mcap --units deg",
)
EXIT_STATUS = {0: "every recording is written"}
DONE = 0
_SECOND = 1_000_000_000
"""Nanoseconds in a second."""
# Smallest correlation of positions with position commands, and largest ratio of their sizes. On the
# SO-101's recordings the smallest correlation is 0.67; a force command of EMPS has 650 times the
# size of the positions.
_FOLLOWS = 0.6
_SAME_SIZE = 3.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("inputs", metavar="INPUT", type=Path, nargs="+", help=RECORDING_HELP)
    parser.add_argument(
        "--out",
        metavar="FILE.mcap",
        type=Path,
        required=True,
        help="written recording; for several inputs or episodes FILE_000.mcap, FILE_001.mcap, ... "
        "in their order; FILE.json next to it lists the content of each",
    )
    add_topics_argument(parser)
    add_reading_arguments(parser)
    parser.add_argument(
        "--trial",
        metavar="KEY=VALUE,...",
        type=parse_trial,
        default={},
        help="metadata of the trial that the file does not carry, such as role=fit, payload=kg05, "
        "controller=soft or temperature='20 C'; they replace those of the recording",
    )
    parser.add_argument(
        "--command-mode",
        choices=COMMAND_MODES,
        help="quantity of commands in formats that do not state it: columns NAME.command of a CSV "
        "file, std_msgs/msg/Float64MultiArray (default: position if they follow the measured "
        "positions, else they are written to all three fields and the model decides)",
    )
    model_files.add_root(parser)


def run(args: argparse.Namespace) -> int:
    """Convert the inputs; return 0.

    Raises:
        TwinError: an input cannot be used.
    """
    out: Path = args.out
    _check_out(out, args.inputs)
    data_name = out.with_suffix(".json").name
    with (
        results.result_folder(out.parent, data_name, replaceable=(out.name,)) as staging,
        Sandbox() as sandbox,
    ):
        summary = sandbox.call(
            "pytest_twin.commands.convert:convert_files",
            {
                "inputs": [str(path) for path in args.inputs],
                "out": str(staging / out.name),
                "topics": args.topics,
                "reading": reading_options(args),
                "trial": args.trial,
                "command_mode": args.command_mode,
            },
        )
        for written in summary["written"]:
            written["file"] = str(out.with_name(Path(written["file"]).name))
        atomic.write_json(staging / data_name, summary)
    json_output.give(args, summary)
    # Names come from files and may contain terminal escape sequences.
    show_lines(_words(summary["written"]))
    return DONE


def convert_files(
    inputs: Sequence[str],
    out: str,
    topics: Mapping[str, str],
    reading: Mapping[str, Any],
    trial: Mapping[str, str],
    command_mode: str | None,
) -> dict[str, Any]:
    """Read all inputs, then write all files; runs in the child process.

    Returns:
        The content of the JSON file that accompanies the recordings.
    """
    options = RecordingOptions.from_json(reading)
    recordings = [
        recording
        for path in inputs
        for recording in read_recordings(Path(path), {**TOPICS, **topics}, **options.reading)
    ]
    files = names_of(Path(out), len(recordings))
    written = []
    for file, recording in zip(files, recordings, strict=True):
        series, notes = convert_series(recording, command_mode)
        recording = replace(recording, metadata={**recording.metadata, **trial})
        write_recording(file, list(series.values()), recording.metadata)
        written.append(_summary(file, recording, series, (*recording.notes, *notes)))
    return {"schema": 1, "written": written}


def names_of(out: Path, count: int) -> list[Path]:
    """Return ``FILE.mcap`` for one recording, ``FILE_000.mcap`` and so on for several."""
    if count == 1:
        return [out]
    width = max(3, len(str(count - 1)))
    return [out.with_name(f"{out.stem}_{number:0{width}d}.mcap") for number in range(count)]


def convert_series(
    recording: Recording, command_mode: str | None
) -> tuple[dict[str, JointSeries], list[str]]:
    """Return the series to write, and notes about assumptions.

    Args:
        command_mode: quantity of commands whose format does not state it.

    Raises:
        RecordingError: the recording has neither states nor commands.
    """
    if not recording.series:
        raise RecordingError(
            "neither states nor commands", path=recording.path,
            expected=what_to_do(recording, "state"),
        )  # fmt: skip
    notes = [_missing_role_note(recording, role) for role in TOPICS if role not in recording.series]
    series = dict(recording.series)
    if any(any(one.degrees) for one in series.values()):
        notes.append(
            "no model says which joints are prismatic: a column in m needs its unit in the "
            "heading, such as 'lift.position [m]'"
        )
    command = series.get("command")
    if command is not None and all(map(command.has_any_quantity, range(len(command.names)))):
        mode = command_mode or _command_kind(command, series.get("state"))
        if mode is None:
            notes.append(
                "the positions do not follow the commands: each command is written as position, "
                "velocity and effort; --command-mode says which of them it is"
            )
        else:
            series["command"] = replace(
                command,
                position=command.position if mode == "position" else None,
                velocity=command.velocity if mode == "velocity" else None,
                effort=command.effort if mode == "effort" else None,
            )
            notes.append(f"the commands are taken as {mode} commands")
    if recording.base is not None:
        notes.append(f"the poses of the base ({recording.base.source}) are not written")
    notes += doubts(replace(recording, series=series))
    earliest = min(int(one.stamp.min()) for one in series.values())
    earliest = min(earliest, *(int(one.log_time.min()) for one in series.values()))
    shift = -(earliest // _SECOND) * _SECOND if earliest < 0 else 0
    if shift:
        notes.append(f"all times are {shift // _SECOND} s later: ROS has no negative times")
    return {
        role: replace(
            one, topic=TOPICS[role], stamp=one.stamp + shift, log_time=one.log_time + shift
        )
        for role, one in series.items()
    }, notes


def _missing_role_note(recording: Recording, role: str) -> str:
    """Return a note that a role is missing, with candidate topics."""
    found = pairs(recording)
    return f"no {role}s" + (f"; to read them: {topics_option(*found[0])}" if found else "")


def _command_kind(command: JointSeries, state: JointSeries | None) -> str | None:
    """Return ``position`` if the positions of most joints follow the commands, else None."""
    if state is None or state.position is None or command.position is None:
        return None
    follows = []
    for joint in command.names:
        if joint not in state.names:
            continue
        sent = command.position[:, command.names.index(joint)]
        measured = state.position[:, state.names.index(joint)]
        seen, known = np.isfinite(measured), np.isfinite(sent)
        if not seen.any() or not known.any():
            continue
        order = np.argsort(state.stamp[seen], kind="stable")
        at = np.interp(command.stamp[known], state.stamp[seen][order], measured[seen][order])
        motion, wanted = float(np.std(at)), float(np.std(sent[known]))
        if not motion or not wanted:
            continue
        correlation = float(np.corrcoef(at, sent[known])[0, 1])
        same_size = motion < _SAME_SIZE * wanted and wanted < _SAME_SIZE * motion
        follows.append(correlation > _FOLLOWS and same_size)
    return "position" if follows and 2 * sum(follows) >= len(follows) else None


def _summary(
    file: Path, recording: Recording, series: Mapping[str, JointSeries], notes: Sequence[str]
) -> dict[str, Any]:
    stamps = np.concatenate([one.stamp for one in series.values()])
    return {
        "file": str(file),
        "recording": str(recording.path),
        "duration": {"value": float(np.ptp(stamps)) * 1e-9, "unit": "s"},
        "topics": {
            role: {
                "topic": one.topic,
                "from": recording.series[role].topic,
                "messages": len(one.stamp),
                "joints": list(one.names),
                "fields": [name for name in QUANTITIES if getattr(one, name) is not None],
            }
            for role, one in series.items()
        },
        "trial": dict(recording.metadata),
        "damage": [str(item) for item in recording.damage],
        "notes": list(notes),
    }


def _words(written: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for each file with its notes; notes common to all files come once, last."""
    several = len(written) > 1
    of_all = [n for n in written[0]["notes"] if several and all(n in w["notes"] for w in written)]
    lines = []
    for one in written:
        topics = one["topics"]
        counts = " and ".join(f"{topic['messages']} {role}s" for role, topic in topics.items())
        joints = {name for topic in topics.values() for name in topic["joints"]}
        lines.append(
            f"{one['file']}: {counts} of {len(joints)} {'joint' if len(joints) == 1 else 'joints'} "
            f"over {one['duration']['value']:.4g} s, from {one['recording']}"
        )
        lines += [f"  damaged: {text}" for text in one["damage"]]
        lines += [f"  note: {text}" for text in one["notes"] if text not in of_all]
    return lines + [f"note: {text}" for text in of_all]


def _check_out(out: Path, inputs: Sequence[Path]) -> None:
    if out.suffix != ".mcap":
        raise TwinError("not a file name of a recording", path=out, expected="--out FILE.mcap")
    if not out.absolute().parent.is_dir():
        raise TwinError("no such folder", path=out.parent, expected="a folder that exists")
    for path in inputs:
        # Writing would replace a file of the bag that is being read.
        if out.resolve() == path.resolve() or path.resolve() in out.resolve().parents:
            raise TwinError(
                "would overwrite the recording itself", path=out, expected="another file"
            )
