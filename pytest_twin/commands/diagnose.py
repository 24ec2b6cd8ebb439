"""``pytest-twin diagnose``: what a model lacks, where, how surely, and what it would buy."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import (
    RECORDING_HELP,
    add_recording_arguments,
    recording_options,
)
from pytest_twin.commands.replay import find_model
from pytest_twin.commands.terminal import show
from pytest_twin.errors import PathError, TwinError
from pytest_twin.formats import atomic
from pytest_twin.gate.diagnosing import DIAGNOSIS_FILE, REALIZATION, REPORT_FILE
from pytest_twin.realization.files.search import SearchFolders
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.report.text import printable

HELP = "name the physics that a model lacks, fit it, and measure the gain on held-out recordings"
EXAMPLES = (
    "pytest-twin diagnose twin.yaml moves.mcap sines.mcap --held-out check.mcap --out diagnosis",
    "pytest-twin replay diagnosis check.mcap --out predicted.mcap",
)
EXIT_STATUS = {
    0: "nothing is left unexplained",
    1: "a mismatch is left that no known effect explains",
}
EXPLAINED, LEFT_OVER = 0, 1
_SECONDS = 4 * 3600.0
# As diagnosis.diagnose and gate.diagnosis_folder report the fraction done.
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
        help="MJCF or URDF file, twin.yaml, or the folder of an earlier diagnosis",
    )
    parser.add_argument(
        "recordings", metavar="RECORDING", type=Path, nargs="+", help=RECORDING_HELP
    )
    parser.add_argument(
        "--held-out",
        metavar="RECORDING",
        type=Path,
        nargs="+",
        action="extend",
        default=[],
        help="recordings that no fit may see (default: those whose metadata says role held_out, "
        "else whole recordings are split and the report says which)",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        required=True,
        help=f"gets {DIAGNOSIS_FILE}, {REPORT_FILE} and {REALIZATION}/, the patched model; "
        "replaced whole where it is an earlier diagnosis",
    )
    add_recording_arguments(parser)
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """0 where nothing is left unexplained, 1 where something is.

    Raises:
        TwinError: input that cannot be used.
    """
    out: Path = args.out.absolute()
    _check_out(out)
    model = find_model(args.model)
    with tempfile.TemporaryDirectory(prefix=".twin-", dir=out.parent) as scratch:
        staging = Path(scratch) / "diagnosis"
        staging.mkdir()
        # The simulator writes its log into the working folder, so that is one that goes.
        with (
            Sandbox(seconds=_SECONDS, cwd=Path(scratch)) as sandbox,
            Progress("diagnosing", _STAGES) as progress,
        ):
            summary = sandbox.call(
                "pytest_twin.commands.diagnose:diagnose_files",
                {
                    "model": str(model),
                    "recordings": [str(r.absolute()) for r in args.recordings],
                    "held_out": [str(r.absolute()) for r in args.held_out],
                    "out": str(staging),
                    "topics": args.topics,
                    "options": recording_options(args),
                    **model_files.search_folders(args),
                },
                progress=progress,
            )
        atomic.replace_directory(staging, out)
    json_output.give(args, json.loads((out / DIAGNOSIS_FILE).read_text("utf-8")))
    show("\n".join(printable(text) for text in summary["words"]))
    show(f"report: {args.out / REPORT_FILE}")
    return EXPLAINED if summary["verdict"] in ("no_mismatch", "explained") else LEFT_OVER


def diagnose_files(
    model: str,
    recordings: list[str],
    held_out: list[str],
    out: str,
    topics: Mapping[str, str],
    options: Mapping[str, Any],
    packages: Mapping[str, str] | None = None,
    roots: Sequence[str] = (),
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Load, diagnose, write; runs in the child process.

    Returns:
        The verdict and the lines to print.
    """
    from pytest_twin.commands.replay import load_model
    from pytest_twin.diagnosis.trials import read_trials
    from pytest_twin.gate.diagnosis_folder import write_diagnosis

    loaded = load_model(Path(model), SearchFolders.of(roots, packages))
    trials = read_trials(
        [Path(r) for r in recordings],
        [Path(r) for r in held_out],
        {**loaded.topics, **topics},
        loaded.realization.structure,
        RecordingOptions.from_json(options).over(loaded.options),
    )
    summary = write_diagnosis(
        Path(out),
        loaded.realization,
        trials,
        inherited=loaded.patched,
        model=Path(model).name,
        progress=progress,
    )
    located = loaded.realization.source.located
    chosen = () if located is None or located.root is None else located.words()
    return {**summary, "words": [*chosen, *summary["words"]]}


def _check_out(out: Path) -> None:
    if not out.parent.is_dir():
        raise TwinError("no such folder", path=out.parent, expected="a folder that exists")
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise PathError("is in the way of a folder", path=out, expected="a folder or nothing")
    if out.is_dir() and any(out.iterdir()) and not (out / DIAGNOSIS_FILE).is_file():
        raise PathError(
            "a folder with other things in it is not replaced",
            path=out,
            expected="a new folder, or that of an earlier diagnosis",
        )


__all__ = ["HELP", "add_arguments", "diagnose_files", "run"]
