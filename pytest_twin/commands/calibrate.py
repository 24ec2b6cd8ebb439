"""``pytest-twin calibrate``: estimate joint zeros, geometry and frames, with held-out errors."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.child_result import add_out, child_result
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.terminal import show_lines
from pytest_twin.commands.time_limit import add_seconds
from pytest_twin.errors import PathError
from pytest_twin.formats import atomic, results
from pytest_twin.interrupts import StopRequest
from pytest_twin.report import calibration
from pytest_twin.report.calibration import conditions_of
from pytest_twin.words import counted

EXAMPLES = (
    "pytest-twin calibrate calibration.yaml --out calibration/",
    "pytest-twin calibrate cell/hand_eye.yaml --out cell/hand_eye/ --json -",
)
EXIT_STATUS = {
    0: "the held-out errors are accepted",
    1: "they are rejected, or the observations do not determine a requested parameter",
}
ACCEPTED, NOT_ACCEPTED = 0, 1
FILE_NAME, PAGE_NAME = "calibration.json", "calibration.html"
OBSERVATIONS = "observations"
"""Folder for tables and images extracted from recordings, for repeated calibrations."""

EXPORTS = (
    "static_transforms.sh",
    "easy_handeye2.calib",
    "calibrated.urdf",
    "calibrated.xml",
    "camera_info.yaml",
)

SECONDS = 300.0
"""Default limit of the processor time, s. A hundred images of two megapixels take a tenth of it."""

_READABLE = {
    "rad": (1e3, "mrad"),
    "m": (1e3, "mm"),
    "s": (1e3, "ms"),
    "px": (1.0, "px"),
    "1": (1.0, ""),
}
"""SI unit -> factor and unit in the printed result."""
_DECIMALS = {"mrad": 2, "mm": 2, "ms": 2, "px": 2, "": 4}
"""Printed unit -> number of decimals."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "plan",
        metavar="PLAN.yaml",
        type=Path,
        help="plan: what to estimate, from which observations",
    )
    add_out(parser, f"folder for {FILE_NAME} and, if it is accepted, {', '.join(EXPORTS)}")
    add_seconds(parser, SECONDS, "the best values so far are written and not accepted")
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Calibrate; return 0 if accepted, 1 if rejected or not determined.

    Raises:
        TwinError: the input cannot be used.
    """
    out: Path = args.out
    progress = Progress("calibrating")
    with progress.stopping_early("the best values so far are written") as stop:
        with progress:
            document = calibrate_into(out, args.plan, args.seconds, stop, progress)
        json_output.give(args, document)
        show_lines(_words(document, out / FILE_NAME))
    return ACCEPTED if document["verdict"] == "accepted" else NOT_ACCEPTED


def calibrate_into(
    out: Path,
    plan: Path,
    seconds: float,
    stop: StopRequest | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Calibrate in a child process, write the folder atomically, and return the document.

    Args:
        out: a new folder, or that of an earlier calibration.
        plan: the plan's file.
        seconds: limit of the processor time, s; 0 for none.
        stop: request that ends the calibration early.

    Raises:
        TwinError: the input cannot be used.
    """
    if not plan.is_file():
        raise PathError("no such file", path=plan, expected="a calibration plan (.yaml)")
    with child_result(out, FILE_NAME, seconds, stop) as (staging, sandbox):
        document = sandbox.call(
            "pytest_twin.calibration.calibrate:calibrate_file",
            {
                "plan": str(plan.absolute()),
                "folder": str(staging / OBSERVATIONS),
                "record_folder": str(out.absolute()),
                "seconds": seconds,
            },
            progress=progress,
        )
        exports = sandbox.call(
            "pytest_twin.calibration.exports:export_files",
            {"plan": str(plan.absolute()), "document": document, "folder": str(out.absolute())},
        )
        page = calibration.render(document, plan.absolute().parent)
        text = atomic.json_text(document)
        for name, content in {FILE_NAME: text, PAGE_NAME: page, **exports}.items():
            atomic.write_text(staging / name, results.as_placed(content, staging))
    placed: dict[str, Any] = json.loads(results.as_placed(text, staging))
    return placed


def _words(document: dict[str, Any], path: Path) -> list[str]:
    conditions = conditions_of(document) if document["verdict"] == "accepted" else []
    on_condition = " on condition" if conditions else ""
    lines = [f"{document['verdict'].capitalize()}{on_condition}: {document['calibration']}"]
    lines += [f"  if {condition}" for condition in conditions]
    lines += [f"  because {reason}" for reason in document["reasons"]]
    for name, record in document["records"].items():
        if record.get("asked", True):
            lines += _record(name, record)
    for name in ("held_out", "fitted"):
        errors = document[name]
        if "translation_rms" not in errors:
            continue
        line = f"{name.replace('_', '-')}: {1e3 * errors['translation_rms']:.3f} mm"
        if "rotation_rms" in errors:
            line += f", {1e3 * errors['rotation_rms']:.3f} mrad"
        lines.append(
            f"{line} (root mean square of all coordinates; of distances "
            f"{1e3 * errors['distance_rms']:.3f} mm; {counted(errors['count'], 'observation')})"
        )
    worst = document["held_out"].get("worst")
    if worst is not None:
        lines.append(
            f"worst held-out observation: {worst['id']}, {1e3 * worst['translation']:.2f} mm"
        )
    pattern = document["held_out"].get("pattern")
    if pattern:
        lines.append(f"pattern: {pattern['words']}")
    left_out: dict[str, list[str]] = {}
    for one in document["excluded"]:
        left_out.setdefault(one["why"], []).append(one["id"])
    lines += [f"left out: {', '.join(ids)}: {why}" for why, ids in left_out.items()]
    lines += [f"not observable: {one}" for one in document["unobservable"]]
    lines += [f"note: {one}" for one in document["notes"]]
    lines.append(f"report: {path.with_name(PAGE_NAME)}")
    return lines


def _record(name: str, record: dict[str, Any]) -> list[str]:
    if "transform" in record:
        xyz = record["transform"]["xyz"]
        widths = [(record["ci95"][axis][1] - record["ci95"][axis][0]) / 2 for axis in "xyz"]
        places = ", ".join(
            f"{axis} {1e3 * value:.2f} ± {1e3 * width:.2f}"
            for axis, value, width in zip("xyz", xyz, widths, strict=True)
        )
        lines = [f"{name}: {record['parent']} to {record['child']}: {places} mm"]
        if record["transform"]["quaternion_wxyz"] is not None:
            turns = [1e3 * record["ci95"][axis][1] for axis in ("rx", "ry", "rz")]
            quaternion = ", ".join(f"{v:.5f}" for v in record["transform"]["quaternion_wxyz"])
            lines.append(
                f"  quaternion (w x y z) {quaternion}, ± "
                + ", ".join(f"{value:.2f}" for value in turns)
                + " mrad"
            )
        return lines
    if "value" in record:
        low, high = record["ci95"]
        if record["unit"] == "1":
            return [f"{name}: {record['value']:.4f} ({low:.4f} to {high:.4f})"]
        line = f"{name}: {1e3 * record['value']:.2f} ms ({1e3 * low:.2f} to {1e3 * high:.2f})"
        return [f"{line}, correlation {record['correlation']:.2f}"]
    values = record["values"]
    lines = [f"{name}:"]
    for label, one in values.items():
        low, high = one["ci95"]
        scale, unit = _READABLE[one["unit"]]
        value = f"{scale * one['value']:.{_DECIMALS[unit]}f} {unit}".rstrip()
        span = f"{scale * low:.{_DECIMALS[unit]}f} to {scale * high:.{_DECIMALS[unit]}f}"
        line = f"  {label} {value} ({span})"
        if one.get("determined_by") == "prior":
            line += ", held by the prior"
        lines.append(line)
    return lines
