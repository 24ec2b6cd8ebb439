"""``pytest-twin intake``: copy a supplier's files unchanged, with digests."""

from __future__ import annotations

import argparse
import datetime
import json
import shlex
from collections.abc import Sequence
from pathlib import Path

from pytest_twin.asset import evidence, manifest
from pytest_twin.asset.manifest import Manifest, State
from pytest_twin.commands import json_output, model_files, xacro_files
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.terminal import show
from pytest_twin.errors import FormatError, PathError, SpecError, TwinError
from pytest_twin.formats import results
from pytest_twin.formats.digest import file_sha256
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.words import counted

EXAMPLES = (
    "pytest-twin intake arm_v3.zip --out arm --supplier 'Arms Ltd'",
    "pytest-twin intake arm_description/urdf/arm.urdf.xacro --out arm",
)
EXIT_STATUS = {0: "the files are copied and the manifest is written"}
DONE = 0
SOURCE = manifest.SOURCE_FOLDER
_MEMORY_BYTES = 2 * 2**30
"""Memory limit of the process that unpacks an archive."""
_SECONDS = 1800.0
"""Time limit of the process that unpacks an archive."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "origin",
        metavar="ARCHIVE|FOLDER|XACRO",
        type=Path,
        help="zip file, tar file, folder, or a xacro file, of which all packages are copied",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="new folder of the asset (default: named as the archive, in the working directory)",
    )
    parser.add_argument("--supplier", metavar="NAME", help="company that delivered it")
    parser.add_argument(
        "--date", metavar="YYYY-MM-DD", help="date of delivery (default: today, UTC)"
    )
    model_files.add_arguments(parser)
    xacro_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Copy the files and write the manifest; return 0.

    Raises:
        TwinError: the archive cannot be unpacked, or the asset exists already.
    """
    origin: Path = args.origin
    if not origin.exists():
        raise PathError(
            "no such archive or folder",
            path=origin,
            expected="a path to a .zip, a .tar or a folder",
        )
    name = origin.resolve().name.split(".")[0] if origin.is_file() else origin.resolve().name
    with xacro_files.expanded(origin.resolve(), args) as expansion:
        folders = None if expansion is None else xacro_files.delivery_of(expansion)
    out: Path = (args.out or Path(name)).resolve()
    if (out / SOURCE).exists() or (out / manifest.FILE_NAME).exists():
        raise SpecError(
            "an asset exists already, and its source is never overwritten",
            path=out,
            value=_comparison(out / manifest.FILE_NAME, origin),
            expected="a new folder",
        )
    if any(out.is_relative_to(one) for one in folders or [origin.resolve()]):
        raise SpecError(
            "the asset would be inside its own source",
            path=out,
            expected="a folder outside it for --out",
        )
    date = _date(args.date)
    with (
        results.result_folder(out, manifest.FILE_NAME) as staging,
        Sandbox(memory_bytes=_MEMORY_BYTES, seconds=_SECONDS) as sandbox,
        Progress("unpacking"),
    ):
        source = staging / SOURCE
        source.mkdir()
        names = _copy(sandbox, folders, origin.resolve(), source)
        found = sandbox.call("pytest_twin.asset.evidence:sort_folder", {"folder": str(source)})
        lacking = evidence.missing(found) + ([] if args.supplier else ["supplier"])
        command = ["pytest-twin", "intake", origin.resolve().name, "--out", "DIR"]
        facts = {
            "made": manifest.made_by(command),
            "folder": SOURCE,
            "supplier": args.supplier,
            "received": date,
            "origin": {
                "name": origin.resolve().name,
                "sha256": file_sha256(origin.resolve()) if origin.is_file() else None,
            },
            "evidence": {
                kind: [f"{SOURCE}/{file}" for file in files] for kind, files in found.items()
            },
            "missing": lacking,
        }
        files = {f"{SOURCE}/{file}": file_sha256(source / file) for file in names}
        state = State(files, facts)
        written = Manifest(name, {"source": state})
        manifest.write(staging / manifest.FILE_NAME, written)
    json_output.give(args, json.loads(written.to_text()))
    _tell(out, found, lacking, state)
    for file in _robots(out, found, None if expansion is None else origin):
        arguments = "".join(f" --xacro {shlex.quote(word)}" for word in args.xacro)
        show(f"next: pytest-twin realize {file} --out {out}{arguments}")
    return DONE


def _copy(
    sandbox: Sandbox, folders: Sequence[Path] | None, origin: Path, source: Path
) -> list[str]:
    """Copy an archive or a folder, or each package to a folder of its name; return the files."""
    if folders is None:
        names: list[str] = sandbox.call(
            "pytest_twin.asset.unpack:unpack", {"origin": str(origin), "folder": str(source)}
        )
        return names
    names = []
    for folder in folders:
        (source / folder.name).mkdir()
        copied = sandbox.call(
            "pytest_twin.asset.unpack:unpack",
            {"origin": str(folder), "folder": str(source / folder.name)},
        )
        names += [f"{folder.name}/{file}" for file in copied]
    return sorted(names)


def _comparison(earlier: Path, origin: Path) -> str | None:
    """Whether an archive is the one that was taken in earlier; None where this is not known."""
    try:
        facts = manifest.read(earlier).states["source"].facts["origin"]
        stated, today = facts["sha256"], file_sha256(origin.resolve())
    except (TwinError, KeyError, TypeError):
        return None
    if not isinstance(stated, str) or stated == today:
        return f"the archive {facts['name']}, unchanged since its intake"
    return (
        f"another archive than {facts['name']} of its intake, SHA-256 {today[:16]}... instead of "
        f"{stated[:16]}..."
    )


def _date(text: str | None) -> str:
    if text is None:
        return datetime.datetime.now(datetime.UTC).date().isoformat()
    try:
        return datetime.date.fromisoformat(text).isoformat()
    except ValueError:
        raise FormatError("not a date", where="--date", value=text, expected="YYYY-MM-DD") from None


def _tell(out: Path, found: dict[str, list[str]], lacking: list[str], state: State) -> None:
    show(f"{out / SOURCE}: {counted(len(state.files), 'file')} frozen, {state.digest[:16]}")
    for kind, files in found.items():
        shown = ", ".join(files[:3]) + (", ..." if len(files) > 3 else "")
        show(f"  {kind}: {len(files)}: {shown}")
    for kind in lacking:
        show(f"  missing: {kind}")


def _robots(out: Path, found: dict[str, list[str]], taken: Path | None) -> list[Path]:
    """The files to realize: the xacro file that was taken in, or those that seem to be robots."""
    if taken is not None:
        return [xacro_files.place_in_delivery(taken, out / SOURCE)]
    models = found.get("model", ())
    return [out / SOURCE / name for name in models if name.endswith((".urdf", ".urdf.xacro"))]
