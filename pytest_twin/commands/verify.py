"""``pytest-twin verify``: whether a release holds."""

from __future__ import annotations

import argparse
from pathlib import Path

from pytest_twin import release
from pytest_twin.commands import json_output
from pytest_twin.commands.terminal import show
from pytest_twin.errors import ReleaseError
from pytest_twin.release.envelope import short
from pytest_twin.words import counted

HELP = "check a release: its signature, every digest, its age, and that no newer one is known"
EXAMPLES = (
    "pytest-twin verify releases/0001",
    "pytest-twin verify received/ --keys trusted-keys/ --json -",
)
EXIT_STATUS = {0: "the release holds", 1: "it does not hold; each reason is listed"}
HOLDS, DOES_NOT_HOLD = 0, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "release", metavar="RELEASE", type=Path, help="a release's folder, or a twin's: its newest"
    )
    parser.add_argument(
        "--keys", metavar="DIR", type=Path, help="trusted public keys (default: the twin's keys/)"
    )


def run(args: argparse.Namespace) -> int:
    """0 the release holds, 1 it does not.

    Raises:
        TwinError: there is nothing to check, or no keys can be read.
    """
    folder = _folder(args.release)
    if args.keys is not None and not args.keys.is_dir():
        raise ReleaseError(
            "no such folder of keys",
            path=args.keys,
            expected="a folder with the public keys (.pub) of those who may sign",
        )
    if args.json not in (None, json_output.STANDARD_OUTPUT):
        _check_outside(Path(args.json), folder)
    verdict = release.check(folder, keys=args.keys, remember=True)
    json_output.give(args, verdict.to_json() | {"path": str(folder)})
    show(_words(verdict, folder))
    return HOLDS if verdict.holds else DOES_NOT_HOLD


def _folder(given: Path) -> Path:
    if not given.is_dir():
        raise ReleaseError("no such release", path=given, expected="the folder of a release")
    if (given / "twin.yaml").exists() or (given / "releases").is_dir():
        found = release.newest(given)
        if found is None:
            raise ReleaseError(
                "this twin has no release yet",
                path=given,
                expected="a signed release; pytest --twin-release writes one",
            )
        return found
    return given


def _check_outside(path: Path, folder: Path) -> None:
    if path.resolve().is_relative_to(folder.resolve()):
        raise ReleaseError(
            "would lie in the release and break it", path=path, expected="another folder"
        )


def _words(verdict: release.Verdict, folder: Path) -> str:
    found = verdict.release
    if found is None:
        lines = [f"does not hold: {folder}"]
    else:
        header = found.header
        name = f"release {header.number} of {header.twin!r}"
        lines = [f"holds: {name}" if verdict.holds else f"does not hold: {name}"]
        lines.append(
            f"  made {header.created}, valid until {header.expires}, "
            f"signed by {short(header.key_id)}"
        )
        if verdict.holds:
            outside = len(found.external)
            also = f"; {counted(outside, 'file')} outside it, by digest" if outside else ""
            lines.append(
                f"  {counted(len(found.goldens), 'golden')}, "
                f"{counted(len(found.files), 'file')} in the release{also}"
            )
    lines += [f"  {problem.text}" for problem in verdict.problems]
    # What a statement or a file name says may carry terminal escapes.
    return "\n".join("".join(c if c.isprintable() else "�" for c in line) for line in lines)
