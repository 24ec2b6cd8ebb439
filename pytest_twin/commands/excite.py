"""``pytest-twin excite``: design safe motions for identification, and predict identifiability."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.child_result import add_out, child_result
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.terminal import show, show_lines
from pytest_twin.commands.time_limit import add_seconds
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.loaded_model import find_model
from pytest_twin.report import excitation
from pytest_twin.words import counted, list_names

EXAMPLES = (
    "pytest-twin excite twin.yaml --out excitation/",
    "pytest-twin excite cell/twin.yaml --out excitation/ --seed 7 --json -",
    "pytest-twin excite twin.yaml --check --out check/",
    "pytest-twin excite twin.yaml --separate backlash@elbow,dead_zone@elbow --out excitation/",
)
EXIT_STATUS = {
    0: (
        "all requested parameters are identifiable by motions within the approved limits; with "
        "--separate: a motion is expected to decide between the hypotheses with 0.9; with --check: "
        "the motions show and distinguish 95 % of what any compared motion does"
    ),
    1: "a parameter is not identifiable, no motion decides, the check misses more, or none is safe",
}
IDENTIFIABLE, NOT_IDENTIFIABLE = 0, 1
FILE_NAME, ABORT_NAME, PAGE_NAME = "excitation.json", "abort.json", "excitation.html"
_MOST_LINES = 12
"""Largest number of unidentifiable parameters that are printed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        type=Path,
        help="twin.yaml with a section excitation: that a qualified person has filled in; missing "
        "lines are printed",
    )
    add_out(parser, f"folder for {FILE_NAME}, {ABORT_NAME}, {PAGE_NAME} and trajectories/")
    parser.add_argument(
        "--seed", metavar="N", type=_seed, default=1, help="seed of all random choices (default: 1)"
    )
    parser.add_argument(
        "--separate",
        metavar="EFFECT[@JOINT],EFFECT[@JOINT]",
        help="choose the motion that tells two effects apart best, such as "
        "backlash@elbow,dead_zone@elbow; pytest-twin effects lists them",
    )
    parser.add_argument(
        "--diagnosis",
        metavar="DIR",
        type=Path,
        help="with --separate: take parameters, joints and noise from the diagnosis in this folder",
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="choose motions, together under a minute, along which the effects can be "
        "distinguished, to be recorded at every release",
    )
    add_seconds(parser, 0.0, "the safe motions so far are written, and the other designs are named")
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Design the motions; return 0 if all parameters are identifiable, else 1.

    Raises:
        TwinError: the input cannot be used, or its limits are not approved.
    """
    if args.diagnosis is not None and args.separate is None:
        raise TwinError("only with --separate", where="--diagnosis", expected="--separate A,B")
    if args.check and args.separate is not None:
        raise TwinError("not with --separate", where="--check", expected="one of both")
    model = str(find_model(args.model))
    out: Path = args.out
    progress = Progress("designing motions")
    with progress.stopping_early("the safe motions so far are written") as stop:
        with (
            child_result(out, FILE_NAME, args.seconds, stop) as (staging, sandbox),
            progress,
        ):
            blank = sandbox.call("pytest_twin.excitation.excite:missing_template", {"model": model})
            if blank["template"]:
                show(blank["template"])
            designed = sandbox.call(*_design(args, model, staging), progress=progress)
            document, abort = designed["document"], designed["abort"]
            atomic.write_json(staging / FILE_NAME, document)
            atomic.write_json(staging / ABORT_NAME, abort)
            page = excitation.render(document, abort, designed["drawn"])
            atomic.write_text(staging / PAGE_NAME, page)
        json_output.give(args, document)
        show_lines(_summary(args, document, out))
        complete = document["verdict"] in ("identifiable", "separable")
        return IDENTIFIABLE if complete else NOT_IDENTIFIABLE


def _design(args: argparse.Namespace, model: str, staging: Path) -> tuple[str, dict[str, Any]]:
    """The function of the child that designs the motions, and its arguments."""
    given = {"model": model, "out": str(staging), "seed": args.seed, "seconds": args.seconds}
    if args.check:
        return "pytest_twin.excitation.check_motion:check_file", given
    if args.separate is None:
        return "pytest_twin.excitation.excite:excite_file", given
    diagnosis = None if args.diagnosis is None else str(args.diagnosis.absolute())
    given |= {"words": args.separate, "diagnosis": diagnosis}
    return "pytest_twin.excitation.separate:separate_file", given


def _seed(word: str) -> int:
    if not word.isdigit() or len(word) > 6:
        raise argparse.ArgumentTypeError(f"{word!r} is not a seed (expected 0 to 999999)")
    return int(word)


def _summary(args: argparse.Namespace, document: dict[str, Any], out: Path) -> list[str]:
    if args.check:
        return _check(document, out)
    return _words(document, out) if args.separate is None else _separation(document, out)


def _words(document: dict[str, Any], out: Path) -> list[str]:
    complete = document["verdict"] == "identifiable"
    motions = document["trajectories"]
    lines = [
        f"{'Identifiable' if complete else 'Not identifiable'}: "
        f"{counted(len(motions), 'motion')} within the limits approved by "
        f"{document['approved_by']}"
    ]
    for name, one in document["covariance"].items():
        line = f"  {name}: {one['identifiable']} of {counted(one['parameters'], 'parameter')}"
        if one["worst_relative_std"] is not None:
            line += (
                f", largest predicted deviation {100 * one['worst_relative_std']:.2g} % "
                f"({one['worst']})"
            )
        lines.append(line)
    reduced = [
        f"{one['name']} to {100 * one['scale']:.0f} %" for one in motions if one["scale"] < 1
    ]
    if reduced:
        lines.append(f"scaled down to be safe: {list_names(reduced, 3)}")
    lines += _refusals(document)
    open_ = document["unidentifiable"]
    lines += [f"! not identifiable: {one}" for one in open_[:_MOST_LINES]]
    if len(open_) > _MOST_LINES:
        lines.append(f"! {len(open_) - _MOST_LINES} more are in {FILE_NAME}")
    return [*lines, *_notes(document, out)]


def _separation(document: dict[str, Any], out: Path) -> list[str]:
    separation = document["separation"]
    first, second = (one["name"] for one in separation["hypotheses"])
    decided = document["verdict"] == "separable"
    lines = [
        f"{'Separable' if decided else 'Not separable'}: {first} and {second}, by "
        f"{separation['signals']} within the limits approved by {document['approved_by']}"
    ]
    for one in separation["expected"]:
        lines.append(f"  {one['trajectory']}: {_chance(one)}")
    usual = separation["usual_motion"]
    if usual is not None:
        lines.append(f"  without hypotheses, the best is {usual['trajectory']}: {_chance(usual)}")
    return [*lines, *_refusals(document), *_notes(document, out)]


def _check(document: dict[str, Any], out: Path) -> list[str]:
    check, motions = document["check"], document["trajectories"]
    seconds = sum(one["duration"]["value"] for one in motions)
    lines = [
        f"{'Sufficient' if document['verdict'] == 'separable' else 'Not sufficient'} check: "
        f"{counted(len(motions), 'motion')}, {seconds:.3g} s together, within the limits approved "
        f"by {document['approved_by']}",
        f"  shows {check['shown']} of {counted(check['showable'], 'effect')}, and "
        f"distinguishes {check['separated']} of {counted(check['separable'], 'pair')}, that any of "
        f"{check['tried']} compared motions shows or distinguishes by {check['signals']} (needed: "
        f"{100 * check['sufficient']:.0f} %)",
    ]
    missed = [",".join(pair) for pair in check["not_separated"]]
    for words, mark, names in (
        (
            "not distinguished; a motion of its own does: pytest-twin excite MODEL --separate",
            "!",
            missed,
        ),
        ("shown only by another motion:", "!", check["not_shown"]),
        ("act alike along every compared motion:", "=", [" = ".join(g) for g in check["groups"]]),
    ):
        lines += [f"{mark} {words} {name}" for name in names[:_MOST_LINES]]
        if len(names) > _MOST_LINES:
            lines.append(f"{mark} {len(names) - _MOST_LINES} more of these are in {FILE_NAME}")
    hidden = check["never_shown"]
    if hidden:
        lines.append(
            "too small to show along any compared motion, at their typical size: "
            + list_names(hidden, 6)
        )
    return [*lines, *_refusals(document), *_notes(document, out)]


def _chance(expected: dict[str, Any]) -> str:
    return f"expected probability of the true one {min(expected['probability'], 0.999):.3g}"


def _refusals(document: dict[str, Any]) -> list[str]:
    return [
        f"X {one['name']}: no safe motion in {counted(one['attempts'], 'attempt')}: "
        + list_names(one["why"], 3, "; ")
        for one in document["refused"]
    ]


def _notes(document: dict[str, Any], out: Path) -> list[str]:
    early = [f"note: {document['ended_early']}"] if document["ended_early"] else []
    return [
        *early, f"note: {document['closed_loop']}", f"note: {document['notice']}",
        f"report: {out / PAGE_NAME}",
    ]  # fmt: skip
