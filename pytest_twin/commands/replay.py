"""``pytest-twin replay``: simulate a model under the commands of a recording."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files, viewer_files
from pytest_twin.commands.prediction import concatenate, distances, predict, predicted_positions
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import (
    RECORDING_HELP,
    add_recording_arguments,
    recording_options,
)
from pytest_twin.commands.terminal import show_lines
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic, results
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import TOPICS
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.report import replay as page
from pytest_twin.trial import at_command_stamps, make_trials, recording_at
from pytest_twin.trial.command_field import refuse_unfit_modes
from pytest_twin.trial.marks import describe_marks, marks_to_json
from pytest_twin.trial.stream_checks import note_on_start_in_motion

EXAMPLES = (
    "pytest-twin replay twin.yaml moves.mcap --out predicted.mcap",
    "pytest-twin replay diagnosis/ moves.mcap --out predicted.mcap --topics state=/arm/states",
)
EXIT_STATUS = {0: "the prediction is written, however far it is from the recording"}
DONE = 0
STATE_TOPIC = TOPICS["state"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        type=Path,
        help="MJCF or URDF file, twin.yaml, or the folder that diagnose wrote",
    )
    parser.add_argument("recording", metavar="RECORDING", type=Path, help=RECORDING_HELP)
    parser.add_argument(
        "--out",
        metavar="FILE.mcap",
        type=Path,
        required=True,
        help=f"predicted {STATE_TOPIC} at the stamps of the recording; FILE.json and FILE.html "
        "next to it compare it with the recording, for each joint and over frequency",
    )
    viewer_files.add_arguments(parser)
    add_recording_arguments(parser)
    parser.add_argument(
        "--episode",
        metavar="N",
        type=int,
        help="number of the episode of a data set, from 0",
    )
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Write the prediction and its comparison; return 0.

    Raises:
        TwinError: the input cannot be used, or the simulation diverged.
    """
    out: Path = args.out
    recording = args.recording.resolve()
    viewer_files.check_name(out, recording, ".mcap")
    viewers = viewer_files.chosen(args, recording)
    if args.view is not None and args.view.resolve() == out.resolve():
        raise TwinError("one file for two results", path=out, where="--view", expected="another")
    data_name, page_name = out.with_suffix(".json").name, out.with_suffix(".html").name
    with (
        results.result_folder(out.parent, data_name, replaceable=(out.name,)) as staging,
        Sandbox() as sandbox,
        Progress("replaying") as progress,
    ):
        summary = sandbox.call(
            "pytest_twin.commands.replay:replay_file",
            {
                "request": {
                    "model": str(find_model(args.model)),
                    "recording": str(recording),
                    "out": str(staging / out.name),
                    "topics": args.topics,
                    "options": recording_options(args),
                    "episode": args.episode,
                    "viewers": viewers,
                },
            },
            progress=progress,
        )
        summary["prediction"] = str(out.absolute())
        atomic.write_json(staging / data_name, summary)
        atomic.write_text(staging / page_name, page.render(summary))
    json_output.give(args, summary)
    show_lines(_words(summary))
    viewer_files.tell(viewers)
    return DONE


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """Arguments of a replay, passed to the child process.

    Attributes:
        recording: file or folder.
        out: file for the prediction.
        topics: role -> topic, overrides the twin's topics.
        options: options for reading recordings, override the twin's options.
        episode: episode of a data set, from 0.
        viewers: ``view`` or ``rerun`` -> file for a viewer.
    """

    model: str
    recording: str
    out: str
    topics: Mapping[str, str]
    options: Mapping[str, Any]
    episode: int | None = None
    viewers: Mapping[str, str] = field(default_factory=dict)


def replay_file(
    request: Mapping[str, Any],
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Load, replay, write; runs in the child process.

    Args:
        request: fields of :class:`ReplayRequest`.
        progress: called with the fraction done.

    Returns:
        The content of the JSON file that accompanies the prediction.
    """
    import mujoco

    from pytest_twin.diagnosis.patched.frequency import best_responses
    from pytest_twin.identification.sensing.reading_prediction import (
        as_encoders_read,
        compare_readings,
        encoders_of,
        sensors_of,
    )
    from pytest_twin.replay_order import doubt_of_order

    asked = ReplayRequest(**request)
    options = RecordingOptions.from_json(asked.options)
    loaded = load_model(Path(asked.model), options.base)
    realization = loaded.realization
    chosen = options.over(loaded.options)
    topics = {**loaded.topics, **asked.topics}
    read = recording_at(Path(asked.recording), topics, chosen, asked.episode)
    trials = make_trials(read, realization.structure, chosen)
    refuse_unfit_modes(realization.structure, trials[0])
    # A single state only gives the start: predict at the stamps of the commands.
    replayed = [t if len(t.time) > 1 else at_command_stamps(t) for t in trials]
    ideal, notes = predict(realization, loaded.patched, replayed, progress)
    doubt = None if loaded.patched else doubt_of_order(realization, replayed[0])
    encoders = encoders_of(realization.twin)
    parts = [as_encoders_read(part, encoders) for part in ideal]
    predicted = concatenate(parts, replayed)
    sensors, unread = compare_readings(
        sensors_of(realization.twin), read.path, realization, concatenate(ideal, replayed),
        topics["state"],
    )  # fmt: skip
    write_recording(Path(asked.out), [predicted], trials[0].metadata)
    if asked.viewers:
        viewer_files.write(asked.viewers, realization, replayed, predicted)
    first = trials[0]
    return {
        "schema": 1,
        "model": asked.model,
        "recording": asked.recording,
        "prediction": asked.out,
        "simulator": f"mujoco {mujoco.__version__}",
        "timestep": {"value": float(realization.model.opt.timestep), "unit": "s"},
        "samples": len(predicted.stamp),
        "duration": {"value": sum(t.duration for t in replayed), "unit": "s"},
        "command_mode": first.command_mode,
        "command_modes": dict(zip(first.command_joints, first.command_modes, strict=True)),
        "command_between": {"value": first.command_between, "source": first.between_source},
        "trial": dict(first.metadata),
        "joints": distances(trials, parts, realization.structure.joint_type),
        "encoder_steps": {joint: one.step for joint, one in encoders.items()},
        "sensors": sensors,
        "frequency_response": best_responses(
            trials,
            lambda at: predicted_positions(parts[at]),
        ),
        "parts": [{"start": t.offset, "end": t.offset + t.duration} for t in replayed],
        "marks": marks_to_json(trials),
        "notes": [
            *(note for t in trials for note in t.notes),
            *(note for t in trials for note in note_on_start_in_motion(t)),
            *([doubt] if doubt else ()),
            *notes,
            *unread,
            *realization.notes,
        ],
    }


def _words(summary: Mapping[str, Any]) -> list[str]:
    between = summary["command_between"]
    said = f"  commands are {between['value']} between their stamps"
    if between["source"] == "assumed":
        said += " (assumed; declare it in twin.yaml or with --command-between)"
    lines = [
        f"{summary['prediction']}: {summary['samples']} states over "
        f"{summary['duration']['value']:.4g} s under {summary['command_mode']} commands",
        said,
    ]
    width = max(len(joint) for joint in summary["joints"])
    for joint, left in summary["joints"].items():
        unit = left["unit"]
        if left["rms"] is None:
            lines.append(f"  {joint:<{width}}  only one state: no comparison")
            continue
        lines.append(
            f"  {joint:<{width}}  rms {_shorten(left['rms'])} {unit}, "
            f"largest {_shorten(left['max'])} {unit} at {left['at']:.4g} s"
        )
    for name, one in summary["sensors"].items():
        channels = (
            f"{axis} {_shorten(one['rms'][axis])} {unit} (an ideal sensor "
            f"{_shorten(one['rms_ideal'][axis])})"
            for axis, unit in one["unit"].items()
        )
        lines.append(f"  {name}: rms {', '.join(channels)}")
    lines += [f"  {line}" for line in describe_marks(summary["marks"])]
    lines += [f"  note: {note}" for note in summary["notes"]]
    return lines


def _shorten(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else str(value)
