"""``pytest-twin show``: summarize a recording, and its use for a diagnosis."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output
from pytest_twin.commands.recording_arguments import (
    RECORDING_HELP,
    add_recording_arguments,
    recording_options,
)
from pytest_twin.commands.recording_summary import episodes_in_words, in_words, survey
from pytest_twin.commands.terminal import show
from pytest_twin.formats.recording import TOPICS
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.report.text import printable

HELP = "summarize a recording: topics, joints, rates, gaps, and missing data"
EXAMPLES = (
    "pytest-twin show moves.mcap",
    "pytest-twin show bag/ --topics state=/arm/joint_states,command=/arm/commands",
    "pytest-twin show log.csv --json - | jq '.recordings[0].missing'",
)
EXIT_STATUS = {0: "the recording can be read, even if a diagnosis cannot use it"}
DONE = 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("recording", metavar="RECORDING", type=Path, help=RECORDING_HELP)
    add_recording_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Show the summary; return 0.

    Raises:
        TwinError: the recording cannot be read.
    """
    with Sandbox() as sandbox:
        found = sandbox.call(
            "pytest_twin.commands.show:show_file",
            {
                "recording": str(args.recording),
                "topics": args.topics,
                "options": recording_options(args),
            },
        )
    json_output.give(args, found)
    one = found["recordings"]
    lines = in_words(found["kind"], one[0]) if len(one) == 1 else episodes_in_words(found)
    # Names come from files and may contain terminal escape sequences.
    show("\n".join(printable(line) for line in lines))
    return DONE


def show_file(
    recording: str, topics: Mapping[str, str], options: Mapping[str, Any]
) -> dict[str, Any]:
    """Read and summarize a recording; runs in the child process.

    Returns:
        The JSON document.
    """
    from pytest_twin.formats.recordings import reader_of
    from pytest_twin.trial import recordings_at

    path = Path(recording)
    chosen = RecordingOptions.from_json(options)
    found = recordings_at(path, {**TOPICS, **topics}, chosen)
    return {
        "schema": 1,
        "recording": recording,
        "kind": reader_of(path).kind,
        "recordings": [survey(one, chosen) for one in found],
    }
