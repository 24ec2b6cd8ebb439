"""``pytest-twin shadow``: compare a candidate with a release on the same recordings."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pytest_twin.adaptation_spec import ResidualSpec, digest_of
from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import RECORDING_HELP
from pytest_twin.commands.release_folder import RELEASE_HELP, release_folder
from pytest_twin.commands.terminal import show_lines
from pytest_twin.commands.time_limit import add_seconds, wall_limit
from pytest_twin.errors import PathError, SpecError
from pytest_twin.formats import atomic
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.release.released_files import copy_release
from pytest_twin.release.restore import read_authentic
from pytest_twin.twin import FILE_NAME, Twin, load_twin

EXAMPLES = (
    "pytest-twin shadow releases/0007 candidate/ day2.mcap day3.mcap",
    "pytest-twin shadow releases/0007 . recordings/*.mcap --promote --json shadow.json",
)
EXIT_STATUS = {
    0: "every declared metric is met, and the fallback holds under each fault",
    1: "the candidate is rejected; each reason is listed",
}
BETTER, REJECTED = 0, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "release",
        metavar="RELEASE",
        type=Path,
        help=RELEASE_HELP,
    )
    parser.add_argument(
        "candidate",
        metavar="CANDIDATE",
        type=Path,
        help="twin.yaml or its folder, with a residual, an online update or another model",
    )
    parser.add_argument(
        "recordings",
        metavar="RECORDING",
        type=Path,
        nargs="+",
        help=f"{RECORDING_HELP}; in chronological order",
    )
    parser.add_argument(
        "--promote",
        action="store_true",
        help="if the candidate is better, write the record that a release requires into its "
        "folder: shadow/ID.json",
    )
    add_seconds(parser, 0.0, "the comparison so far is shown, and the candidate is rejected")
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Compare; return 0 if the candidate is better, 1 if it is rejected.

    Raises:
        TwinError: the release is invalid, or the candidate or a recording cannot be used.
    """
    given: Path = args.candidate
    file = given / FILE_NAME if given.is_dir() else given
    if not file.is_file():
        raise PathError("no candidate", path=given, expected=f"{FILE_NAME}, or its folder")
    candidate = load_twin(file)
    spec = candidate.residual or candidate.update
    if args.promote and spec is None:
        raise SpecError(
            "nothing to promote: the candidate declares no residual and no update",
            path=file,
            expected="residual: or update:; pytest --twin-release releases a changed model",
        )
    folder = release_folder(args.release)
    release = read_authentic(folder, datetime.now(UTC))
    root = folder.absolute().parent.parent
    progress = Progress("simulating")
    with progress.stopping_early("the comparison so far is shown") as stop:
        with (
            temporary_folder() as scratch,
            Sandbox(seconds=wall_limit(args.seconds), stop=stop) as sandbox,
            progress,
        ):
            document = sandbox.call(
                "pytest_twin.adaptation.shadow:shadow",
                {
                    "released": str(copy_release(release, folder, root, Path(scratch).resolve())),
                    "candidate": str(file.absolute()),
                    "recordings": [str(path.absolute()) for path in args.recordings],
                    "seconds": args.seconds,
                },
            )
        document = {
            "schema": 1,
            "twin": release.twin,
            "release": release.number,
            "release_sha256": release.sha256,
            "candidate": str(file),
            "id": None if spec is None else spec.id,
            "digest": _digest(candidate),
            "recordings": [path.name for path in args.recordings],
            **document,
        }
        json_output.give(args, document)
        lines = _words(document)
        if args.promote and spec is not None and document["verdict"] == "better":
            record = candidate.shadow_record(spec.id)
            atomic.make_folder(record.parent)
            atomic.write_json(record, document)
            lines.append(f"promoted: {record}")
            lines.append("next: pytest --twin-release")
        show_lines(lines)
        return BETTER if document["verdict"] == "better" else REJECTED


def _digest(candidate: Twin) -> str | None:
    spec = candidate.residual or candidate.update
    if spec is None:
        return None
    file = spec.file if isinstance(spec, ResidualSpec) else None
    return digest_of(spec, None if file is None else file_sha256(file))


def _words(document: dict[str, Any]) -> list[str]:
    name = document["id"] or document["candidate"]
    lines = [
        f"{document['verdict']}: {name} in the shadow of release {document['release']} of "
        f"{document['twin']!r}"
    ]
    for one in document["metrics"]:
        kind = "safety, may rise by" if one["safety"] else "must fall by"
        change = "nothing measured" if one["change"] is None else f"{100 * one['change']:+.2f} %"
        mark = "met" if one["met"] else "NOT MET"
        lines.append(f"  {mark}: {one['metric']} {change} ({kind} {100 * one['declared']:g} %)")
        for joint, pair in one["joints"].items():
            unit = one["units"][joint]
            lines.append(f"    {joint}: {pair['release']:.4g} -> {pair['candidate']:.4g} {unit}")
    for fault in document["faults"]:
        mark = "holds" if fault["holds"] else "DOES NOT HOLD"
        lines.append(f"  {mark}: fallback under {fault['fault']}: {fault['why']}")
    acting = document["acting"]
    if acting is not None:
        kept = "; ".join(f"{why} {100 * s:.1f} %" for why, s in acting["kept_out"].items())
        lines.append(
            f"  in use {100 * acting['share']:.1f} % of the time" + f" ({kept})" * bool(kept)
        )
    update = document.get("update")
    if update is not None:
        for at, parameter in enumerate(update["parameters"]):
            unit = update["units"][at]
            lines.append(
                f"  {parameter}: {update['base'][at]:.4g} -> {update['value'][at]:.4g} "
                f"+- {update['deviation'][at]:.2g}" + f" {unit}" * (unit != "1")
            )
        lines += [
            f"  NOT MET: {one['parameter']} stays at its bound of {one['bound']:g}"
            for one in update["at_bounds"]
        ]
    return [*lines, *(f"  note: {note}" for note in document["notes"])]
