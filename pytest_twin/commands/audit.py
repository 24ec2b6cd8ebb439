"""``pytest-twin audit``: report faults and unknown properties of a robot's file."""

from __future__ import annotations

import argparse
from pathlib import Path

from pytest_twin.commands import json_output, model_files, xacro_files
from pytest_twin.commands.robot_audit import audit_robot
from pytest_twin.commands.terminal import show
from pytest_twin.errors import TwinError
from pytest_twin.formats.expansions import EXPANDED, SUFFIX
from pytest_twin.report.audit import table

EXAMPLES = (
    "pytest-twin audit arm.urdf",
    "pytest-twin audit arm.srdf --urdf arm.urdf",
    "pytest-twin audit arm.urdf --package arm_description=../arm_description --json - | jq .counts",
)
EXIT_STATUS = {0: "no critical finding", 1: "at least one critical finding"}
CLEAN, CRITICAL = 0, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("asset", metavar="ASSET", type=Path, help="URDF, MJCF, USD or SRDF file")
    parser.add_argument(
        "--urdf",
        metavar="FILE",
        type=Path,
        help="URDF of an SRDF (default: the file for the same robot in its folder, in ../urdf, "
        "../robots, or in the description package next to *_moveit_config)",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path(),
        help="folder for NAME.audit.json and NAME.audit.html, where NAME is the asset's (default: "
        "the working directory)",
    )
    parser.add_argument(
        "--evidence",
        metavar="FILE",
        type=Path,
        help="YAML file with evidence from other sources: signs, zeros, ranges, poses, commands",
    )
    model_files.add_arguments(parser)
    xacro_files.add_arguments(parser)
    parser.add_argument("--all", action="store_true", help="print all findings in full")


def run(args: argparse.Namespace) -> int:
    """Audit a file; return 0 without and 1 with a critical finding.

    Raises:
        TwinError: the file cannot be read.
    """
    asset: Path = args.asset
    out: Path = args.out
    found, located = audit_robot(asset, out, _call(args), args)
    json_output.give(args, found)
    for line in located:
        show(line)
    show(table(found, every=args.all))
    for srdf in found["facts"].get("srdf", ()):
        show(f"SRDF beside it, not audited here: pytest-twin audit {srdf}")
    name = f"{asset.name}.audit"
    if asset.suffix == SUFFIX:
        show(f"expanded by xacro; lines are those of {out / name}{EXPANDED}")
    show(f"report: {out / name}.html, {out / name}.json")
    return CRITICAL if found["counts"]["critical"] else CLEAN


def _call(args: argparse.Namespace) -> tuple[str, dict[str, object]]:
    """Return the function of the child process, and its arguments."""
    asset: Path = args.asset
    for path in (asset, args.urdf, args.evidence):
        if path is not None and not path.is_file():
            raise TwinError(
                "not a file" if path.exists() else "no such file",
                path=path,
                expected="a URDF, MJCF, USD or SRDF file" if path is asset else "a file",
            )
    arguments: dict[str, object] = {
        "path": str(asset.resolve()),
    }
    if asset.suffix.lower() == ".srdf" or args.urdf is not None:
        if args.evidence is not None:
            raise TwinError(
                "an SRDF takes no evidence", path=asset, where="--evidence", expected="a URDF"
            )
        arguments["urdf_path"] = None if args.urdf is None else str(args.urdf.resolve())
        return "pytest_twin.audit.srdf.audit_srdf:audit_srdf", arguments
    arguments["evidence_path"] = None if args.evidence is None else str(args.evidence.resolve())
    return "pytest_twin.audit.audit_file:audit_file", arguments
