"""``pytest-twin show``: summarize a recording, and its use for a diagnosis."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.recording_arguments import (
    RECORDING_HELP,
    add_recording_arguments,
    options_as_typed,
    recording_options,
)
from pytest_twin.commands.recording_summary import episodes_in_words, in_words, survey
from pytest_twin.commands.terminal import show_lines
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import TOPICS
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.twin import model_suffixes

EXAMPLES = (
    "pytest-twin show moves.mcap",
    "pytest-twin show twin.yaml moves.mcap",
    "pytest-twin show bag/ --topics state=/arm/joint_states,command=/arm/commands",
    "pytest-twin show log.csv --json - | jq '.recordings[0].missing'",
)
EXIT_STATUS = {0: "the recording can be read, even if a diagnosis cannot use it"}
DONE = 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        type=Path,
        nargs="?",
        help="MJCF or URDF file, twin.yaml, or the folder that diagnose wrote: the recording is "
        "read as its commands read it",
    )
    parser.add_argument("recording", metavar="RECORDING", type=Path, help=RECORDING_HELP)
    add_recording_arguments(parser)
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Show the summary; return 0.

    Raises:
        TwinError: the recording or the model cannot be read.
    """
    if args.model is None:
        _refuse_model(args.recording)
    with Sandbox() as sandbox:
        found = sandbox.call(
            "pytest_twin.commands.show:show_file",
            {
                "recording": str(args.recording),
                "topics": args.topics,
                "options": recording_options(args),
                "model": None if args.model is None else str(find_model(args.model)),
            },
        )
    json_output.give(args, found)
    one, options = found["recordings"], options_as_typed(args)
    lines = (
        in_words(found["kind"], one[0], args.model, options)
        if len(one) == 1
        else episodes_in_words(found, args.model, options)
    )
    # Names come from files and may contain terminal escape sequences.
    show_lines(lines)
    return DONE


def _refuse_model(given: Path) -> None:
    """Refuse a model in the place of the recording.

    Raises:
        RecordingError: the path is a model or a ``twin.yaml``.
    """
    if given.suffix.lower() in (*model_suffixes(), ".yaml", ".yml"):
        raise RecordingError(
            "a model, not a recording",
            path=given,
            expected=f"pytest-twin show {given} RECORDING; pytest-twin audit reports on a model",
        )


def show_file(
    recording: str,
    topics: Mapping[str, str],
    options: Mapping[str, Any],
    model: str | None = None,
) -> dict[str, Any]:
    """Read and summarize a recording; runs in the child process.

    Args:
        recording: file or folder.
        topics: role -> topic, overrides the twin's topics.
        options: options for reading recordings, override the twin's options.
        model: path of the model, or None.

    Returns:
        The JSON document.
    """
    from pytest_twin.formats.recordings import reader_of
    from pytest_twin.trial import recordings_at

    path = Path(recording)
    chosen = RecordingOptions.from_json(options)
    realization, all_topics = None, {**TOPICS, **topics}
    if model is not None:
        loaded = load_model(Path(model), chosen.base)
        realization = loaded.realization
        chosen, all_topics = chosen.over(loaded.options), {**loaded.topics, **topics}
    found = recordings_at(path, all_topics, chosen)
    return {
        "schema": 1,
        "recording": recording,
        "model": model,
        "kind": reader_of(path).kind,
        "recordings": [survey(one, chosen, realization) for one in found],
    }
