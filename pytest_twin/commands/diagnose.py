"""``pytest-twin diagnose``: find effects that a model lacks, with confidence and held-out gain."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pytest_twin.commands import before, fleet, json_output, model_files, viewer_files
from pytest_twin.commands.child_result import add_out, child_result
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import (
    add_recording_arguments,
    add_recordings,
    recording_options,
)
from pytest_twin.commands.terminal import show, show_lines
from pytest_twin.commands.time_limit import add_seconds
from pytest_twin.errors import TwinError
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.gate.failure_diagnosis import DIAGNOSIS_FILE, REALIZATION, REPORT_FILE
from pytest_twin.interrupts import StopRequest
from pytest_twin.loaded_model import find_model
from pytest_twin.processor_time import call_began
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.recording_options import RecordingOptions

EXAMPLES = (
    "pytest-twin diagnose twin.yaml moves.mcap sines.mcap --held-out check.mcap --out diagnosis",
    "pytest-twin replay diagnosis check.mcap --out predicted.mcap",
    "pytest-twin diagnose --fleet fleet.yaml --out diagnoses",
    "pytest-twin diagnose twin.yaml today.mcap --before may_*.mcap --out changes",
)
EXIT_STATUS = {
    0: "no residual is unexplained; with --before: nothing changed",
    1: "a residual remains that no known effect explains; with --before: something changed",
}
EXPLAINED, LEFT_OVER = 0, 1
SECONDS = 240.0
"""Default limit of the processor time of a diagnosis, s."""
# Fractions reported by diagnosis.diagnose and gate.diagnosis_folder at the start of each stage.
_STAGES = (
    (0.0, "reading the recordings"),
    (0.02, "measuring the noise floor"),
    (0.06, "searching for effects"),
    (0.9, "computing confidence intervals"),
    (0.94, "writing the report"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        type=Path,
        nargs="?",
        help="MJCF or URDF file, twin.yaml, or the folder of an earlier diagnosis",
    )
    add_recordings(
        parser,
        nargs="*",
        held_out="test recordings, which are read only after effects and parameters are final "
        "(default: those with the role held_out in their metadata, else whole recordings are "
        "split and the report lists them)",
    )
    add_out(
        parser,
        f"folder for {DIAGNOSIS_FILE}, {REPORT_FILE} and {REALIZATION}/, the patched model; "
        "the files of an earlier diagnosis are replaced",
    )
    before.add_arguments(parser)
    add_seconds(
        parser, SECONDS,
        "the best result so far is written with a list of the searches that were not done; with "
        "--fleet, each robot has an equal share, and by default its own limit",
    )  # fmt: skip
    # A fleet tells a given limit of all robots from the default one of each.
    parser.set_defaults(seconds=None)
    fleet.add_arguments(parser, "diagnose")
    viewer_files.add_arguments(parser)
    add_recording_arguments(parser)
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Diagnose; return 0 if no residual is unexplained, else 1.

    Raises:
        TwinError: the input cannot be used.
    """
    arguments = {
        "topics": args.topics,
        "options": recording_options(args),
        "seconds": SECONDS if args.seconds is None else args.seconds,
    }
    if (args.fleet is not None or args.before) and (args.view or args.rerun):
        raise TwinError(
            "only for the diagnosis of one robot", where="--view, --rerun",
            expected="pytest-twin replay DIR RECORDING --out FILE.mcap --view FILE.mcap",
        )  # fmt: skip
    if args.fleet is not None:
        if args.before:
            raise TwinError(
                "--before and --fleet cannot be combined",
                where="--before",
                expected="MODEL RECORDING... --before RECORDING... for one robot",
            )
        if args.model is not None:
            raise TwinError(
                "MODEL and --fleet cannot be combined",
                where="--fleet",
                value=args.model,
                expected="one of them",
            )
        return fleet.run(args, arguments)
    if args.model is None or not args.recordings:
        raise TwinError(
            "nothing to diagnose",
            where="MODEL RECORDING",
            expected="a model and at least one recording, or --fleet FILE.yaml",
        )
    if args.before:
        return before.run(args, arguments["seconds"])
    fleet.refuse_alone(args)
    out: Path = args.out.absolute()
    drawn = (args.held_out or args.recordings)[0].resolve()
    viewers = viewer_files.chosen(args, drawn)
    progress = Progress("diagnosing", _STAGES)
    with progress.stopping_early("the best result so far is written") as stop:
        with progress:
            summary = diagnose_into(
                out, args.model, args.recordings, args.held_out, arguments, stop, progress
            )
        json_output.give(args, json.loads((out / DIAGNOSIS_FILE).read_text("utf-8")))
        show_lines(summary["words"])
        show(f"report: {args.out / REPORT_FILE}")
        if viewers:
            _write_viewer_files(viewers, out, drawn, arguments)
    return EXPLAINED if summary["verdict"] in ("no_mismatch", "explained") else LEFT_OVER


def _write_viewer_files(
    viewers: Mapping[str, str], folder: Path, recording: Path, arguments: Mapping[str, Any]
) -> None:
    """Replay a recording on the diagnosed model, and write both robots for viewers."""
    with temporary_folder() as temporary, Sandbox() as sandbox:
        sandbox.call(
            "pytest_twin.commands.replay:replay_file",
            {
                "request": {
                    "model": str(find_model(folder)),
                    "recording": str(recording),
                    "out": str(temporary / "predicted.mcap"),
                    "topics": arguments["topics"],
                    "options": arguments["options"],
                    "viewers": viewers,
                }
            },
        )
    viewer_files.tell(viewers)


# Files, options and the two ways to its parent are independent of each other.
def diagnose_into(
    out: Path,
    model: Path,
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    arguments: Mapping[str, Any],
    stop: StopRequest | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Diagnose in a child process, write the folder atomically, and return the child's summary.

    Args:
        out: absolute path of a new or empty folder, or of an earlier diagnosis.
        model, recordings, held_out: files and folders, as on the command line.
        arguments: further fields of :class:`DiagnosisRequest`.
        stop: request that ends the search early.

    Raises:
        TwinError: the input cannot be used.
    """
    model_file = find_model(model)
    seconds = arguments["seconds"]
    with child_result(out, DIAGNOSIS_FILE, seconds, stop, alone=True) as (staging, sandbox):
        summary: dict[str, Any] = sandbox.call(
            "pytest_twin.commands.diagnose:diagnose_files",
            {
                "request": {
                    "model": str(model_file),
                    "recordings": [str(r.absolute()) for r in recordings],
                    "held_out": [str(r.absolute()) for r in held_out],
                    "out": str(staging),
                    "folder": str(out.absolute()),
                    **arguments,
                },
            },
            progress=progress,
            tell=None if progress is None else progress.tell,
        )
    return summary


@dataclass(frozen=True, slots=True)
class DiagnosisRequest:
    """Arguments of a diagnosis, passed to the child process.

    Attributes:
        out: an empty folder.
        folder: folder that it becomes; itself if empty.
        topics: role -> topic, overrides the twin's topics.
        options: options for reading recordings, override the twin's options.
        seconds: limit of the processor time, s; 0 for no limit.
        threads: number of simulation threads, 0 for all cores.
    """

    model: str
    recordings: Sequence[str]
    held_out: Sequence[str]
    out: str
    topics: Mapping[str, str]
    options: Mapping[str, Any]
    seconds: float = 0.0
    threads: int = 0
    folder: str = ""


def diagnose_files(
    request: Mapping[str, Any],
    progress: Callable[[float], None] = lambda fraction: None,
    tell: Callable[[str, str], None] = lambda kind, text: None,
) -> dict[str, Any]:
    """Load, diagnose, write; runs in the child process.

    At the time limit and at a stop request of the parent, the best result so far is written.

    Args:
        request: fields of :class:`DiagnosisRequest`.
        progress: called with the fraction done.
        tell: called with states and lines for the terminal.

    Returns:
        The verdict and the lines to print.
    """
    from pytest_twin.diagnosis.budget import RESERVED_SHARE, Budget
    from pytest_twin.diagnosis.first_answer import FIRST_SECONDS, first_answer
    from pytest_twin.diagnosis.run import Run
    from pytest_twin.diagnosis.trace import Step, Trace
    from pytest_twin.diagnosis.trials import read_trials
    from pytest_twin.diagnosis.unit_check import drop_other_units
    from pytest_twin.gate.diagnosis_folder import write_diagnosis
    from pytest_twin.loaded_model import load_model
    from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings
    from pytest_twin.realization.record_inputs import states_of_records
    from pytest_twin.records.state import stale_lines
    from pytest_twin.replay_order import refuse_other_order
    from pytest_twin.report.quick_diagnosis import quick_diagnosis_in_words
    from pytest_twin.trial.command_field import refuse_unfit_modes

    asked = DiagnosisRequest(**request)
    budget = Budget(asked.seconds, begin=call_began())
    options = RecordingOptions.from_json(asked.options)
    loaded = load_model(Path(asked.model), options.base)
    trials = read_trials(
        [Path(r) for r in asked.recordings],
        [Path(r) for r in asked.held_out],
        {**loaded.topics, **asked.topics},
        loaded.realization.structure,
        options.over(loaded.options),
    )
    for trial in (*trials.fit, *trials.held_out):
        refuse_unfit_modes(loaded.realization.structure, trial)
    if loaded.patched is None:
        refuse_other_order(loaded.realization, trials.fit)
    # The first answer would explain degrees by physics.
    other_units: list[str] = []
    trials = drop_other_units(loaded.realization, trials, other_units)
    trials = replace(trials, notes=(*trials.notes, *other_units))

    def say_state(step: Step) -> None:
        first = [f"{effect.place[0]} (first answer)" for effect in diagnosis_run.first_answer]
        best = ", ".join(step.best or first) or "no effect yet"
        left = f"; at most {budget.left:.0f} processor seconds left" if budget.seconds else ""
        tell("state", f"{step.stage}; best so far: {best}{left}")

    diagnosis_run = Run(budget, Trace(say_state))
    bound = min(FIRST_SECONDS, (1.0 - RESERVED_SHARE) * budget.left)
    seen = None
    if bound > 0.0:
        with suppress_mujoco_warnings():
            seen = first_answer(loaded.realization, trials.fit, loaded.patched, bound)
    diagnosis_run.first_answer = () if seen is None else seen.likely_effects
    words = "none in time" if seen is None else quick_diagnosis_in_words(seen)
    tell("line", f"first answer, from one recording: {words}")
    summary = write_diagnosis(
        Path(asked.out),
        loaded.realization,
        trials,
        model=Path(asked.model).name,
        threads=asked.threads,
        progress=progress,
        run=diagnosis_run,
        record_folder=Path(asked.folder or asked.out),
    )
    located = loaded.realization.source.located
    chosen = () if located is None or located.root is None else located.words()
    twin = loaded.realization.twin
    stale = () if twin is None else stale_lines(states_of_records(twin), twin)
    return {**summary, "words": [*chosen, *stale, *summary["words"]]}


__all__ = ["add_arguments", "diagnose_files", "run"]
