"""``pytest-twin stamp``: write the IDs of a release into a data set or policy."""

from __future__ import annotations

import argparse
from pathlib import Path

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.recording_arguments import parse_joints
from pytest_twin.commands.release_folder import RELEASE_HELP, release_folder
from pytest_twin.commands.terminal import show_lines
from pytest_twin.release import stamps
from pytest_twin.release.stamp import PARTS, VARIANTS
from pytest_twin.words import counted

EXAMPLES = (
    "pytest-twin stamp datasets/pick --release releases/0007",
    "pytest-twin stamp policy.onnx --release . --json -",
)
EXIT_STATUS = {0: "every file of the data set is stamped"}
DONE = 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "dataset",
        metavar="DATASET",
        type=Path,
        help="LeRobot data set, MCAP, HDF5 or ONNX file, or a folder of such files",
    )
    parser.add_argument(
        "--release",
        metavar="RELEASE",
        type=Path,
        required=True,
        help=f"{RELEASE_HELP}: the one that the data were made with",
    )

    for part in VARIANTS:
        parser.add_argument(
            f"--{part}",
            metavar="NAME",
            help=f"{part} that all data were made with, as in {part}s: of twin.yaml (default: the "
            "one that the metadata of each MCAP file name, else none is stamped)",
        )
    parser.add_argument(
        "--joints",
        metavar="prefix=left_|RECORDED=RELEASED,...|none",
        type=_parse_joints,
        default={},
        help="joint names of the data: a prefix or suffix of the release's names, or single names; "
        "none if the data name no joints (default: 'joints:' of twin.yaml)",
    )
    model_files.add_root(parser)


def _parse_joints(text: str) -> dict[str, str] | None:
    return None if text == "none" else parse_joints(text)


def run(args: argparse.Namespace) -> int:
    """Stamp every file; return 0.

    Raises:
        TwinError: the release is invalid, or the data set cannot be stamped.
    """
    found = stamps.put(
        args.dataset,
        release_folder(args.release),
        payload=args.payload,
        controller=args.controller,
        joints=args.joints,
    )
    first = found[0].stamp
    assert first is not None
    json_output.give(
        args,
        {
            "schema": 1,
            "dataset": str(args.dataset),
            **first.ids,
            "files": [
                {
                    "path": str(one.carrier.path),
                    "sha256": one.stamp.data,
                    "target": str(one.target) if one.target is not None else None,
                    "unknown_joints": [] if one.joints is None else list(one.joints.unknown),
                }
                for one in found
                if one.stamp is not None
            ],
        },
    )
    lines = [f"stamped: {args.dataset} with {first.name} ({counted(len(found), 'file')})"]
    used = stamps.variants(found)
    for part in (*PARTS, "payload"):
        member = first.ids[part]
        name = member["id"] or "none"
        if part in VARIANTS:
            name = ", ".join(used[part]) or f"not stated: give --{part} if the data used one"
        lines.append(f"  {part:<12} {name}  {member['digest'][:16]}")
    lines += [
        f"  note: {one.carrier.path.name} names {part} {name!r}, which release "
        f"{first.ids['release']} does not declare: the stamp names none"
        for one in found
        for part, name in one.undeclared.items()
    ]
    lines += [
        f"  note: {one.carrier.path.name}: {one.joints.note}"
        for one in found
        if one.joints is not None and one.joints.note
    ]
    show_lines(lines)
    return DONE
