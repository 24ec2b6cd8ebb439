"""``pytest-twin audit-changes``: audit the robots that a change affects, for CI and hooks."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from pytest_twin.commands import json_output, model_files, xacro_files
from pytest_twin.commands.affected_robots import affected, changed_since, checkout
from pytest_twin.commands.robot_audit import audit_robot
from pytest_twin.commands.terminal import show
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats import atomic
from pytest_twin.report import baseline as baselines
from pytest_twin.report.ci import Problem, annotation, junit, sarif
from pytest_twin.report.text import printable
from pytest_twin.words import counted

EXAMPLES = (
    "pytest-twin audit-changes --since origin/main --sarif audit.sarif --junit audit.xml",
    "pytest-twin audit-changes meshes/wrist.stl urdf/arm.urdf",
    "pytest-twin audit-changes --baseline audit-baseline.yaml --accept",
)
EXIT_STATUS = {
    0: "no critical finding that is not accepted",
    1: "at least one critical finding that is not accepted",
}
CLEAN, CRITICAL = 0, 1
_SHOWN = ("critical", "warning")
"""Severities that are reported; the reports of --out have all."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "files", metavar="FILE", type=Path, nargs="*",
        help="changed files: robots, files that they include, meshes (default: all robots)",
    )  # fmt: skip
    parser.add_argument("--since", metavar="REVISION", help="files changed since this git revision")
    parser.add_argument(
        "--baseline", metavar="FILE.yaml", type=Path, help="accepted findings; may be missing"
    )
    parser.add_argument(
        "--accept", action="store_true", help="write all findings to --baseline as accepted"
    )
    parser.add_argument("--sarif", metavar="FILE", type=Path, help="write findings as SARIF 2.1.0")
    parser.add_argument("--junit", metavar="FILE", type=Path, help="write findings as JUnit XML")
    parser.add_argument(
        "--annotate", action="store_true",
        help="print findings as workflow commands, which GitHub shows at their lines",
    )  # fmt: skip
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="folder for the reports (default: none are kept)",
    )
    model_files.add_arguments(parser)
    xacro_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Audit the affected robots; return 1 if a critical finding is not accepted.

    Raises:
        TwinError: this is no checkout, or a robot cannot be read.
    """
    if args.accept and args.baseline is None:
        raise SpecError("no file", where="--accept", expected="--baseline FILE.yaml")
    if args.since and args.files:
        raise SpecError(
            "both files and a revision", where="--since", value=args.since, expected="one of them"
        )
    root = checkout()
    changed = changed_since(root, args.since) if args.since else args.files or None
    robots = affected(root, changed)
    problems: list[Problem] = []
    unreadable: list[TwinError] = []
    with tempfile.TemporaryDirectory() as temporary:
        for robot in robots:
            name = robot.relative_to(root)
            folder = (args.out or Path(temporary)) / name.parent
            folder.mkdir(parents=True, exist_ok=True)
            try:
                document, _ = audit_robot(robot, folder, _call(robot), args)
            except TwinError as error:
                unreadable.append(error)
                problems.append(Problem.of_error(str(name), error, root))
                continue
            problems += [
                Problem.of_finding(str(name), row, root)
                for row in document["findings"]
                if row["severity"] in _SHOWN
            ]
    known = {} if args.baseline is None or args.accept else baselines.read(args.baseline)
    new = [one for one in problems if one.key not in known]
    names = [str(robot.relative_to(root)) for robot in robots]
    audited = {*names} - {one.robot for one in problems if one.code == "unusable"}
    gone = [key for key in known if key.robot in audited and key not in {p.key for p in problems}]
    if args.accept:
        baselines.write(args.baseline, [p for p in problems if p.code != "unusable"])
        new = [one for one in problems if one.code == "unusable"]
    if args.sarif is not None:
        atomic.write_text(args.sarif, sarif(new))
    if args.junit is not None:
        atomic.write_text(args.junit, junit(names, new))
    json_output.give(args, _document(names, new, len(problems) - len(new), gone))
    for one in new:
        show(printable(one.line_of_text()))
    if args.annotate:
        for one in new:
            show(annotation(one))
    for key in gone:
        show(printable(f"accepted, and no longer there: {key.robot}: {key.code}: {key.element}"))
    critical = sum(one.severity == "critical" for one in new)
    show(
        f"{counted(len(robots), 'robot')}, {critical} critical, {len(new) - critical} warnings, "
        f"{len(problems) - len(new)} accepted"
    )
    if unreadable:
        raise unreadable[0]
    return CRITICAL if critical else CLEAN


def _call(robot: Path) -> tuple[str, dict[str, object]]:
    if robot.suffix.lower() == ".srdf":
        arguments: dict[str, object] = {"path": str(robot.resolve()), "urdf_path": None}
        return "pytest_twin.audit.srdf.audit_srdf:audit_srdf", arguments
    arguments = {"path": str(robot.resolve()), "evidence_path": None}
    return "pytest_twin.audit.audit_file:audit_file", arguments


def _document(
    robots: list[str], new: list[Problem], accepted: int, gone: list[baselines.Key]
) -> dict[str, Any]:
    return {
        "schema": 1,
        "verdict": "critical" if any(one.severity == "critical" for one in new) else "clean",
        "robots": robots,
        "findings": [one.to_json() for one in new],
        "accepted": accepted,
        "gone": [key._asdict() for key in gone],
    }
