"""``pytest-twin realize``: convert a URDF to normalized URDF, MJCF and USD, with a loss matrix."""

from __future__ import annotations

import argparse
import base64
import json
import re
from pathlib import Path
from typing import Any

from pytest_twin.asset import manifest, placement
from pytest_twin.commands import json_output, model_files, xacro_files
from pytest_twin.commands.child_result import add_out
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.terminal import show
from pytest_twin.errors import PathError, SpecError
from pytest_twin.formats import atomic, results
from pytest_twin.formats.expansions import EXPANDED
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.words import counted

EXAMPLES = (
    "pytest-twin realize arm.urdf --out arm",
    "pytest-twin realize arm.urdf --out arm --accept inertia-repair:wrist",
)
EXIT_STATUS = {
    0: "every form represents what the URDF states",
    1: "a critical field is lost or invalid",
}
CLEAN, CRITICAL = 0, 1
_PATCH = re.compile(r"[a-z-]+:.+")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("urdf", metavar="URDF", type=Path, help="URDF or xacro file of the robot")
    add_out(parser, "folder of the converted asset")
    parser.add_argument(
        "--accept",
        metavar="PATCH",
        action="append",
        default=[],
        help="accept one named repair of the asset, such as inertia-repair:LINK; may be repeated",
    )
    model_files.add_arguments(parser)
    xacro_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Convert; return 0 if every form represents the URDF, 1 if a critical field fails.

    Critical findings of ``audit`` in the normalized form also count as failures. An accepted
    repair removes its finding.

    Without the extra ``usd``, USD is omitted with a note, which is not a failure.

    Raises:
        TwinError: the file contains no robot that can be read.
    """
    source: Path = args.urdf
    if not source.is_file():
        raise PathError("no such file", path=source, expected="a URDF")
    source = source.parent.resolve() / source.name
    for patch in args.accept:
        if not _PATCH.fullmatch(patch):
            raise SpecError(
                "not a named patch", where="--accept", value=patch, expected="inertia-repair:LINK"
            )
    frozen = placement.frozen_source(source)
    out: Path = args.out.resolve()
    with (
        xacro_files.expanded(source, args) as expansion,
        results.result_folder(out, manifest.FILE_NAME, stays=manifest.SOURCE_FOLDER) as staging,
        Sandbox() as sandbox,
        Progress("realizing") as progress,
    ):
        if frozen is not None and expansion is not None:
            placement.require_in_source(expansion.read, *frozen)
        made = sandbox.call(
            "pytest_twin.asset.realize:realize",
            {
                "source": str(source),
                "folder": str(staging),
                "accept": args.accept,
            },
            progress=progress,
        )
        normalized = staging / f"{made['asset']}.urdf"
        if normalized.is_file():
            known = "\n".join(made["critical"])
            made["critical"] += [
                results.as_placed(line, staging)
                for line in sandbox.call(
                    "pytest_twin.audit.audit_file:critical_findings", {"path": str(normalized)}
                )
                # Each note of the conversion is listed once.
                if not any(word in known for word in re.findall(r"'([^']+)'", line))
            ]
            _add_thumbnail(staging, normalized, sandbox)
        placement.complete(staging, out, source, made)
    json_output.give(args, made)
    _tell(args.out, made)
    if expansion is not None:
        show(
            f"{source.name} was expanded by xacro; lines in changes.md are those of "
            f"{args.out / made['asset']}{EXPANDED}"
        )
    return CRITICAL if made["critical"] else CLEAN


def _add_thumbnail(staging: Path, normalized: Path, sandbox: Sandbox) -> None:
    """Write the picture of the stage where OpenUSD's browsers look for it."""
    stage = normalized.with_suffix(".usdc")
    if not stage.is_file():
        return
    picture = sandbox.call(
        "pytest_twin.audit.thumbnail:thumbnail_of_file", {"path": str(normalized)}
    )
    if picture is not None:
        path = staging / f".thumbs/256x256/{stage.name}.png"
        path.parent.mkdir(parents=True)
        atomic.write_bytes(path, base64.b64decode(picture))


def _tell(out: Path, made: dict[str, Any]) -> None:
    for line in made["located"]["words"]:
        show(line)
    for name in manifest.STATES:
        state = made["manifest"]["states"].get(name)
        if state is not None:
            show(f"{name}: {counted(len(state['files']), 'file')}, {state['digest'][:16]}")
    for conversion, counts in made["counts"].items():
        show(f"{conversion}: " + ", ".join(f"{n} {word}" for word, n in counts.items()))
    show(f"{counted(made['changes'], 'change')}: {out / 'changes.md'}; loss: {out / 'loss.html'}")
    for line in made["left_out"]:
        show(f"pytest-twin realize: {line}", error=True)
    for line in made["critical"]:
        show(f"FAILS: {line}", error=True)
    for patch in made["patches"]:
        show(f"to accept its repair: --accept {json.dumps(patch)}", error=True)
