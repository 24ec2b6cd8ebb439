"""``pytest-twin export``: write findings as another simulator takes them, with what is lost."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pytest_twin.asset.loss.matrix import Conversion, Matrix
from pytest_twin.asset.loss.render import html
from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.child_result import add_out, child_result
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.terminal import show, show_lines
from pytest_twin.errors import SpecError
from pytest_twin.export.target import STEPPED, TARGETS, exporter
from pytest_twin.formats import atomic, typed
from pytest_twin.loaded_model import find_model

EXAMPLES = (
    "pytest-twin export diagnosis --to mujoco --out plain",
    "pytest-twin export twin.yaml --to isaaclab --out lab",
)
EXIT_STATUS = {0: "the files are written; the loss matrix lists what they lack"}
DONE = 0
EXPORT_FILE, LOSS_FILE = "export.json", "loss.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "source",
        metavar="DIAGNOSIS|TWIN",
        type=Path,
        help="twin.yaml or its folder (or the folder that diagnose wrote, or a model file)",
    )
    parser.add_argument("--to", metavar="TARGET", choices=TARGETS, required=True,
                        help=f"simulator: {', '.join(TARGETS)}")  # fmt: skip
    add_out(
        parser,
        f"folder for the files of the simulator, {EXPORT_FILE} and {LOSS_FILE}, the loss "
        "matrix; the files of an earlier export are replaced",
    )
    parser.add_argument(
        "--held-out",
        metavar="RECORDING",
        nargs="+",
        type=Path,
        default=[],
        help="recordings that measure the loss (default: the held-out ones of the diagnosis)",
    )
    parser.add_argument(
        "--engine",
        metavar="PYTHON",
        type=Path,
        help="Python of an environment with the simulator's package (mjlab, drake or newton): "
        "steps the export on at most 20 s of the held-out recordings, and measures the loss",
    )
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Export; return 0.

    Raises:
        TwinError: the input cannot be used.
    """
    find_model(args.source)
    if args.engine is not None and args.to not in STEPPED:
        raise SpecError(
            "this target is not stepped in its own simulator", where="--engine", value=args.to,
            expected=f"--to {' or '.join(STEPPED)}, or none of --engine",
        )  # fmt: skip
    out: Path = args.out.absolute()
    with (
        child_result(out, EXPORT_FILE, 0.0, None, alone=True) as (staging, sandbox),
        Progress("exporting") as progress,
    ):
        document = sandbox.call(
            "pytest_twin.commands.export:export_files",
            {
                "source": str(args.source.resolve()),
                "target": args.to,
                "out": str(staging),
                "held_out": [str(path.resolve()) for path in args.held_out],
                "engine": None if args.engine is None else str(args.engine.absolute()),
            },
            progress=progress,
        )
    json_output.give(args, document)
    show_lines(words(document))
    show(f"loss matrix: {args.out / LOSS_FILE}")
    return DONE


def export_files(
    source: str,
    target: str,
    out: str,
    held_out: list[str],
    engine: str | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Read, export, write; runs in the child process.

    Args:
        source: diagnosis or twin.
        target: one of ``TARGETS``.
        out: an empty folder.
        held_out: recordings that measure the loss.
        engine: Python of an environment with the target's package.
        progress: called with the fraction done.

    Returns:
        The content of ``export.json``.
    """
    from pytest_twin.export.source import read_source

    read = read_source(
        Path(source), [Path(path) for path in held_out], Path(engine) if engine else None
    )
    progress(0.1)
    exported = exporter(target)(read, Path(out))
    progress(0.95)
    conversion = Conversion(
        "pytest-twin", target, f"{exported.engine} ({exported.checked})", exported.rows
    )
    matrix = Matrix(read.loaded.realization.name, Path(source).name, (conversion,))
    document = {
        "schema": 1,
        "target": target,
        "source": source,
        "files": list(exported.files),
        "engine": exported.engine,
        "checked": exported.checked,
        "held_out": typed.plain(dict(exported.held_out)),
        "rows": [typed.plain(row) for row in exported.rows],
        "notes": [*read.notes, *exported.notes],
    }
    atomic.write_text(Path(out) / LOSS_FILE, html(matrix))
    atomic.write_text(
        Path(out) / EXPORT_FILE, json.dumps(document, indent=2, allow_nan=False) + "\n"
    )
    return document


def words(document: Mapping[str, Any]) -> list[str]:
    """Lines for a terminal: files, each effect, errors of the joints, notes."""
    lines = [
        f"{', '.join(document['files'])}: {document['checked']} with {document['engine']}",
    ]
    for row in document["rows"]:
        cost = ""
        if row["difference"] is not None:
            cost = f" ({row['difference']:+.1%} {row['unit']})"
        lines.append(f"  {row['verdict']:<7}  {row['feature']}: {row['after']}{cost}")
    for joint, error in document["held_out"].items():
        exported = error["rms_exported"]
        text = "diverges" if exported is None else f"{exported:.4g} {error['unit']}"
        lines.append(
            f"  {joint}: held-out error {text}, of the diagnosed model "
            f"{error['rms_diagnosed']:.4g} {error['unit']}"
        )
    return [*lines, *(f"  note: {note}" for note in document["notes"])]
