"""``pytest-twin replay``: what a model does under the commands of a recording."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pytest_twin.commands import json_output
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.terminal import show
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats import atomic
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.formats.recording import TOPICS, JointSeries
from pytest_twin.metrics.residual import residual
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.trial import Trial, make_trial
from pytest_twin.twin import FILE_NAME, MODEL_SUFFIXES, Twin, load_twin

if TYPE_CHECKING:
    from pytest_twin.diagnosis.patched.model import Patched
    from pytest_twin.effects.segment import Predicted
    from pytest_twin.realization import Realization
    from pytest_twin.replay import Replayed

HELP = "simulate a model under a recording's commands, open loop, and write the predicted states"
EXAMPLES = (
    "pytest-twin replay twin.yaml moves.mcap --out predicted.mcap",
    "pytest-twin replay diagnosis/ moves.mcap --out predicted.mcap --topics state=/arm/states",
)
EXIT_STATUS = {0: "the prediction is written, however far it is from the recording"}
DONE = 0
STATE_TOPIC = TOPICS["state"]
# In a folder that diagnose wrote, the first of these that is there.
_IN_FOLDER = (f"realization/{FILE_NAME}", "realization/model.xml", FILE_NAME)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        type=Path,
        help="MJCF or URDF file, twin.yaml, or the folder that diagnose wrote",
    )
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="MCAP file")
    parser.add_argument(
        "--out",
        metavar="FILE.mcap",
        type=Path,
        required=True,
        help=f"the predicted {STATE_TOPIC}, at the stamps of the recording; FILE.json beside it "
        "says how far it is from the recording, joint by joint",
    )
    parser.add_argument(
        "--topics",
        metavar="state=/x,command=/y",
        type=parse_topics,
        default={},
        help="topics of the recording (default: twin.yaml's, else "
        + ",".join(f"{role}={topic}" for role, topic in TOPICS.items())
        + ")",
    )


def run(args: argparse.Namespace) -> int:
    """0 once both files are written.

    Raises:
        TwinError: input that cannot be used, or a simulation that diverged.
    """
    out: Path = args.out
    recording = args.recording.resolve()
    _check_out(out, recording)
    with Sandbox() as sandbox, Progress("replaying") as progress:
        summary = sandbox.call(
            "pytest_twin.commands.replay:replay_file",
            {
                "model": str(find_model(args.model)),
                "recording": str(recording),
                "out": str(out.absolute()),
                "topics": args.topics,
            },
            progress=progress,
        )
    atomic.write_text(out.with_suffix(".json"), json.dumps(summary, indent=2) + "\n")
    json_output.give(args, summary)
    show(_words(summary))
    return DONE


def find_model(given: Path) -> Path:
    """The model or ``twin.yaml`` that a command line names.

    Raises:
        SpecError: a folder with neither, or a file of another kind.
    """
    if given.is_dir():
        for name in _IN_FOLDER:
            if (given / name).is_file():
                return (given / name).resolve()
        raise SpecError("no model in this folder", path=given, expected=" or ".join(_IN_FOLDER))
    if not given.exists():
        raise SpecError("no such model", path=given, expected="a file or a folder")
    if given.suffix.lower() not in (*MODEL_SUFFIXES, ".yaml", ".yml"):
        raise SpecError(
            "no model that can be replayed",
            path=given,
            expected="MJCF (.xml, .mjcf), URDF (.urdf), twin.yaml, or the folder of a diagnosis",
        )
    return given.resolve()


def replay_file(
    model: str,
    recording: str,
    out: str,
    topics: Mapping[str, str],
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Load, replay, write; runs in the child process.

    Returns:
        What stands in the JSON beside the prediction.
    """
    import mujoco

    loaded = load_model(Path(model))
    realization = loaded.realization
    trial = make_trial(
        read_recording(Path(recording), {**loaded.topics, **topics}), realization.structure
    )
    predicted, notes = _predict(loaded, trial, progress)
    write_recording(Path(out), [predicted], trial.metadata)
    return {
        "schema": 1,
        "model": model,
        "recording": recording,
        "prediction": out,
        "simulator": f"mujoco {mujoco.__version__}",
        "timestep": {"value": float(realization.model.opt.timestep), "unit": "s"},
        "samples": len(trial.time),
        "duration": {"value": trial.duration, "unit": "s"},
        "command_mode": trial.command_mode,
        "trial": dict(trial.metadata),
        "joints": _joints(trial, predicted, realization.structure.joint_type),
        "marks": [
            {
                "kind": mark.kind,
                "topic": mark.topic,
                "joint": mark.joint,
                "start": mark.start,
                "end": mark.end,
                "text": mark.text,
            }
            for mark in trial.marks
        ],
        "notes": [*notes, *realization.notes],
    }


@dataclass(frozen=True, slots=True)
class LoadedModel:
    """What a command line's MODEL is.

    Attributes:
        realization: loaded, with its twin where it has one.
        topics: role -> topic.
        patched: effects that are stepped beside the model, where a diagnosis wrote it.
    """

    realization: Realization
    topics: Mapping[str, str]
    patched: Patched | None


def load_model(file: Path) -> LoadedModel:
    """Load what :func:`find_model` found; in the child process.

    Raises:
        TwinError: it cannot be loaded.
    """
    from pytest_twin.diagnosis.patched.model import patched_of
    from pytest_twin.realization import load

    twin: Twin | None = None
    name = "mujoco"
    if file.suffix.lower() in (".yaml", ".yml"):
        twin = load_twin(file)
        if not twin.realizations:
            raise SpecError("this twin has no model", path=file, where="model")
        name, reference = next(iter(twin.realizations.items()))
        file = reference.file
    realization = load(file, twin=twin, name=name)
    topics = dict(TOPICS if twin is None else twin.topics)
    return LoadedModel(realization, topics, patched_of(realization))


def _predict(
    loaded: LoadedModel, trial: Trial, progress: Callable[[float], None]
) -> tuple[JointSeries, tuple[str, ...]]:
    """The joint states that the model predicts for a trial, and notes."""
    from pytest_twin.diagnosis.patched.replay import beside_in_words, replay_patched
    from pytest_twin.replay import replay

    stamps = trial.stamps

    def series(names: tuple[str, ...], values: Replayed | Predicted) -> JointSeries:
        return JointSeries(
            topic=STATE_TOPIC,
            names=names,
            stamp=stamps,
            log_time=stamps,
            position=values.position,
            velocity=values.velocity,
            effort=values.effort,
        )

    if loaded.patched is None:
        result = replay(loaded.realization, [trial], tcp=False, progress=progress)[0]
        if result.error is not None:
            raise result.error
        return series(trial.joints, result), result.notes
    predicted = replay_patched(loaded.realization, loaded.patched, [trial])[0]
    return series(loaded.patched.joints, predicted), beside_in_words(loaded.patched)


def _joints(trial: Trial, predicted: JointSeries, types: Mapping[str, str]) -> dict[str, Any]:
    found = {}
    assert predicted.position is not None
    for column, joint in enumerate(predicted.names):
        measured = trial.position[:, trial.joints.index(joint)]
        left = residual(predicted.position[:, column], measured)
        found[joint] = {
            "rms": left.rms,
            "max": left.maximum,
            "mean": left.mean,
            "at": float(trial.time[left.maximum_at]),
            "unit": "m" if types[joint] == "slide" else "rad",
        }
    return found


def parse_topics(text: str) -> dict[str, str]:
    """``state=/x,command=/y`` of a command line, as a mapping."""
    found: dict[str, str] = {}
    for item in text.split(","):
        role, separator, topic = item.partition("=")
        if not separator or role not in TOPICS or not topic or role in found:
            raise argparse.ArgumentTypeError(
                f"{text!r}: expected state=/x,command=/y or one of them"
            )
        found[role] = topic
    return found


def _check_out(out: Path, recording: Path) -> None:
    if out.suffix != ".mcap":
        raise TwinError("no name for a recording", path=out, expected="--out FILE.mcap")
    if out.resolve() == recording:
        raise TwinError("would overwrite the recording itself", path=out, expected="another file")
    if not out.absolute().parent.is_dir():
        raise TwinError("no such folder", path=out.parent, expected="a folder that exists")


def _words(summary: Mapping[str, Any]) -> str:
    lines = [
        f"{summary['prediction']}: {summary['samples']} states over "
        f"{summary['duration']['value']:.4g} s under {summary['command_mode']} commands"
    ]
    width = max(len(joint) for joint in summary["joints"])
    for joint, left in summary["joints"].items():
        unit = left["unit"]
        lines.append(
            f"  {joint:<{width}}  rms {_short(left['rms'])} {unit}, "
            f"largest {_short(left['max'])} {unit} at {left['at']:.4g} s"
        )
    kinds: dict[str, int] = {}
    for mark in summary["marks"]:
        kinds[mark["kind"]] = kinds.get(mark["kind"], 0) + 1
        if mark["kind"] == "damage":
            lines.append(f"  damaged: {mark['text']}")
    if kinds:
        said = ", ".join(f"{kind} {count}" for kind, count in kinds.items())
        lines.append(f"  doubtful stretches of the recording, all kept: {said}")
    lines += [f"  note: {note}" for note in summary["notes"]]
    # Names and notes come from files and may carry terminal escapes.
    return "\n".join("".join(c if c.isprintable() else "�" for c in line) for line in lines)


def _short(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else str(value)
